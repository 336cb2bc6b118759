/** What is wrong with a file: the byte where it was noticed, what was wanted and what was found. */
export class FgsError extends Error {
  readonly offset: number;
}

/** A file of which any part can be had. `read` gives fewer bytes only at the file's end. */
export interface RangedSource {
  size: number;
  read(offset: number, length: number): Promise<Uint8Array>;
}

/** The ends of a file on a server, or all of it as it comes. It can be posted to a worker; a stream has to be transferred. */
export type Prefetched = { url: string; size: number; first: Uint8Array; last: Uint8Array } | { stream: ReadableStream<Uint8Array> };

/** Ask a server for the first and the last bytes of a file, while the worker that decodes it is still starting. */
export function prefetch(url: string | URL, init?: RequestInit): Promise<Prefetched>;

/**
 * An address is asked for ranges; a server without them, a `Response` and a stream are read as they come. In Node a string without a
 * scheme and a `file:` address are files, and a stream of its own (`Readable`) is a stream.
 */
export type Source =
  | ArrayBuffer
  | ArrayBufferView
  | Blob
  | ReadableStream<Uint8Array>
  | Response
  | string
  | URL
  | RangedSource
  | Prefetched
  | { pipe: Function };

export interface OpenOptions {
  /** Name of the file, which errors begin with. */
  name?: string;
  /** Passed to `fetch` with an address: headers, credentials, a signal. */
  fetch?: RequestInit;
}

export interface ChunkOptions {
  /** False leaves out the SH above degree 0; true by default. */
  sh?: boolean;
  /** Stop after so many layers. */
  layers?: number;
  /** Number of the first chunk that is wanted. Of a ranged source, those before are not read. */
  first?: number;
}

export interface Steps {
  position: number;
  scale: number;
  rotation: number;
  opacity: number;
  dc: number;
  chroma: number;
  sh: number[];
  contraction?: Contraction;
}

/** Of positions: docs/format.md. */
export interface Contraction {
  centre: [number, number, number];
  radius: number;
}

/** Codes of version 2. Positions are relative to the origin. */
export interface GridCodes {
  /** x, y, z */
  position: [Int32Array, Int32Array, Int32Array];
  scale: [Int32Array, Int32Array, Int32Array];
  /** x, y, z of the quaternion */
  rotation: [Int32Array, Int32Array, Int32Array];
  opacity: Int32Array;
  /** Y, Co, Cg */
  dc: [Int32Array, Int32Array, Int32Array];
  /** SH degree of each row */
  degrees: Uint8Array;
  /** For each degree from 1: the rows that have it, and the planes of all Y, all Co, all Cg of its coefficients. */
  sh: { rows: Int32Array; planes: Int32Array[] }[];
}

/** Codes of version 1, a plane for each channel. SH have fewer rows. */
export type PackedCodes = Record<keyof Values, Uint16Array[]>;

/** Planes, one after the other: `means` holds all x, then all y, then all z. The same bits as from `flexgs-edge decompress`. */
export interface Values {
  /** Positions relative to the origin. */
  means: Float32Array;
  /** Red, green, blue of degree 0. */
  shDc: Float32Array;
  /** All coefficients of red, then green, then blue; 0 above a row's degree. */
  shRest: Float32Array;
  opacityLogits: Float32Array;
  logScales: Float32Array;
  /** w, x, y, z */
  quats: Float32Array;
}

export interface Chunk<Codes = GridCodes | PackedCodes> {
  readonly index: number;
  readonly layer: number;
  /** First of its rows in the scene. */
  readonly start: number;
  readonly rows: number;
  readonly codes: Codes;
  /** False while a stream comes in: its checksums come last, and a mismatch ends the loop with an error. */
  readonly verified: boolean;
  values(): Values;
}

export interface Header {
  version: 1 | 2;
  count: number;
  shDegree: number;
  origin: [number, number, number];
  settings: Record<string, unknown>;
  layers: number[];
  chunkCount: number;
  /** Of version 1: of its positions, null if they are not contracted. In version 2 it stands in `steps`. */
  contraction?: Contraction | null;
  /** Of version 2. */
  steps?: Steps;
  low?: [number, number, number];
  depth?: number;
  chunkRows?: number;
  cutFrom?: { bytes: number; count: number; layers: number } | null;
  channels?: { bytes: number[]; rows: number[] } | null;
  /** Bytes of the preview; 0 if there is none. */
  previewBytes?: number;
}

export class FgsFile {
  readonly version: 1 | 2;
  /** Bytes. */
  readonly size: number;
  readonly count: number;
  readonly shDegree: number;
  /** World = origin + mean, in double precision. */
  readonly origin: [number, number, number];
  /** How the file was made, and how it is drawn: `near`, `background`, `extent`, `antialiased`; and `boxes`, where chunks lie. */
  readonly settings: Record<string, unknown>;
  /** Rows of each layer. */
  readonly layers: number[];
  readonly chunkCount: number;
  readonly header: Header;
  /** Chunk after chunk, each decoded when it is asked for. A stream can be read once. */
  chunks(options?: ChunkOptions): AsyncGenerator<Chunk, void, void>;
  /** One chunk; only of a source of which any part can be had: not of a stream, or of a server that does not know ranges. */
  chunk?(index: number, options?: { sh?: boolean }): Promise<Chunk>;
  /** The bytes of the preview, which is a file of its own; none if there is none. */
  previewBytes(): Promise<Uint8Array>;
  /** Stop reading a stream. */
  close(): Promise<void>;
}

/** Open a file: read and check its header and its model. Throws `FgsError` for a file that breaks the format. */
export function open(source: Source, options?: OpenOptions): Promise<FgsFile>;

/** Open the preview of a file: the same scene in far fewer Gaussians, to show until the first layer is there. Null if there is none. */
export function openPreview(file: FgsFile, name?: string): Promise<FgsFile | null>;

/** Whether bytes begin like a `.fgs` file of any version. */
export function looksLikeFgs(bytes: Uint8Array): boolean;
