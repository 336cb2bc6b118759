import type { AppBase, GraphicsDevice, GSplatData, GSplatResource } from 'playcanvas';
import type { FgsFile } from './index.js';

/** Decode a file into the engine's numbers. Positions are relative to `file.origin`; SH of degree 4 are left out, since PlayCanvas has none. */
export function splatDataOf(file: FgsFile): Promise<GSplatData>;

/** Decode a file into what `entity.addComponent('gsplat', { resource })` takes. */
export function splatsOf(file: FgsFile, device: GraphicsDevice): Promise<GSplatResource>;

/** Draw splats as INRIA's renderer and `flexgs-edge render` do, with WebGL2. Call it before anything is drawn. */
export function drawLikeRender(app: AppBase, antialiased?: boolean): void;
