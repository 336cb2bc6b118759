import { VERSION1 } from './version1.js';
import { VERSION2 } from './version2.js';

/**
 * What the versions of the container differ in: the header; what all chunks share; where chunks lie and how they decode.
 * `fault` texts are "" where there is no fault.
 */
export const FORMATS = { 1: VERSION1, 2: VERSION2 };
