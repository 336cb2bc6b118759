import type { Chunk, ChunkOptions, FgsFile, GridCodes, OpenOptions, PackedCodes, Source, Values } from './index.js';

export { FgsError } from './index.js';

export interface WorkerOptions extends OpenOptions {
  /** A worker that runs `worker.js`, or a port that `serve` listens to. By default one is started. */
  worker?: Worker | MessagePort;
}

/** Its arrays were handed over by the worker: codes, or values if they were asked for. */
export type WorkerChunk = Pick<Chunk, 'index' | 'layer' | 'start' | 'rows' | 'verified'> & {
  codes?: GridCodes | PackedCodes;
  values?: Values;
};

export type WorkerFile = Omit<FgsFile, 'chunks'> & {
  chunks(options?: ChunkOptions & { values?: boolean }): AsyncGenerator<WorkerChunk, void, void>;
};

/** Open a file in a worker, which decodes one chunk ahead. */
export function openInWorker(source: Source, options?: WorkerOptions): Promise<WorkerFile>;
