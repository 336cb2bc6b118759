// Numbers of docs/format.md.
export const PREAMBLE_BYTES = 36;
export const MAGIC = [0x93, 0x46, 0x47, 0x53, 0x0d, 0x0a, 0x1a, 0x0a];
export const COUNT_MOST = 2 ** 32 - 1;
export const DEGREE_MOST = 4;
export const HEADER_MOST = 1 << 20;
export const MODEL_MOST = 1 << 20;
export const PREVIEW_MOST = 1 << 24;
export const LAYERS_MOST = 256;
export const CHUNK_ROWS = 65536;
export const DEPTH_MOST = 21;
/** Largest magnitude of a code: binary32 holds all of them exactly. */
export const CODE_LIMIT = 1 << 24;
/** Largest magnitude of a value in predictions. */
export const VALUE_LIMIT = 16383;
/** Largest magnitude of a contraction's numbers, and of what it expands to. */
export const LARGEST = 2 ** 126;
