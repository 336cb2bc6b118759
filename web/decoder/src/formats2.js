import { VERSION2 } from './version2.js';

/** Version 2 alone, in the place of `formats.js`: for a page whose scene is of version 2. */
export const FORMATS = { 2: VERSION2 };
