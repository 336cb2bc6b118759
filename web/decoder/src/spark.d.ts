import type { ExtSplats, SparkRenderer } from '@sparkjsdev/spark';
import type { FgsFile } from './index.js';

/** Decode a file into splats. Positions are relative to `file.origin`; SH of degree 4 are left out, since Spark has none. */
export function splatsOf(file: FgsFile): Promise<ExtSplats>;

/** What makes Spark draw a model as INRIA's renderer and `flexgs-edge render` do; its own defaults are others. */
export function sparkOptions(antialiased?: boolean): Record<string, unknown>;

/** Limit how large splats far outside of the picture become. Call it before anything is drawn. */
export function limitSides(spark: SparkRenderer): void;
