// A .fgs as splats of PlayCanvas (https://playcanvas.com).
import { GSPLATDATA_LARGE, GSplatData, GSplatResource, SHADERLANGUAGE_GLSL, ShaderChunks } from 'playcanvas';

const MOST_DEGREE = 3;
/** The planes of `Values` and the names that PlayCanvas has for them, those of INRIA's PLY. */
const NAMES = {
  means: ['x', 'y', 'z'],
  shDc: ['f_dc_0', 'f_dc_1', 'f_dc_2'],
  opacityLogits: ['opacity'],
  logScales: ['scale_0', 'scale_1', 'scale_2'],
  quats: ['rot_0', 'rot_1', 'rot_2', 'rot_3'],
};

/**
 * Decode a file into the engine's numbers. Positions are relative to `file.origin`; SH of degree 4 are left out, since PlayCanvas has none.
 *
 * @param {import('@flexgs/decoder').FgsFile} file
 * @returns {Promise<GSplatData>} float32: 56 bytes a splat, 236 with SH
 */
export async function splatDataOf(file) {
  const degree = Math.min(file.shDegree, MOST_DEGREE);
  const each = (degree + 1) ** 2 - 1;
  const fileEach = (file.shDegree + 1) ** 2 - 1;
  const rest = Array.from({ length: 3 * each }, (_, k) => `f_rest_${k}`);
  const properties = [...Object.values(NAMES).flat(), ...rest].map((name) => ({
    type: 'float',
    name,
    storage: new Float32Array(file.count),
    byteSize: 4,
  }));
  const data = new GSplatData([{ name: 'vertex', count: file.count, properties }]);
  for await (const chunk of file.chunks({ sh: degree > 0 })) {
    const values = chunk.values();
    const put = (name, planes, k) => data.getProp(name).set(planes.subarray(k * chunk.rows, (k + 1) * chunk.rows), chunk.start);
    for (const [field, names] of Object.entries(NAMES)) names.forEach((name, k) => put(name, values[field], k));
    rest.forEach((name, k) => put(name, values.shRest, Math.floor(k / each) * fileEach + (k % each)));
  }
  return data;
}

/**
 * Decode a file into what `entity.addComponent('gsplat', { resource })` takes.
 *
 * @param {import('@flexgs/decoder').FgsFile} file
 * @param {import('playcanvas').GraphicsDevice} device `app.graphicsDevice`
 * @returns {Promise<GSplatResource>}
 */
export async function splatsOf(file, device) {
  return new GSplatResource(device, await splatDataOf(file));
}

const CHANGED = '// changed\n';
/** In the engine's shaders, by the chunk's name: what they say, and what they have to say to draw as INRIA's renderer does. */
const CHANGES = {
  gsplatCornerVS: [
    // Its focal length is that of pixels half as wide, which leave a quarter of the dilation by 0.3 square pixels.
    [' + 0.3', ' + 1.2'],
    ['max(mid - radius, 0.1)', 'max(mid - radius, 0.4)'],
    // Splats far outside of the picture become no larger than at its sides.
    ['/ vp.z * vp.xy;', '* clamp(vp.xy / vp.z, -1.3 / abs(focal) * viewport_size.xy, 1.3 / abs(focal) * viewport_size.xy);'],
    ['min(1024.0, min(viewport_size.x, viewport_size.y))', '1e5'],
  ],
  // Gaussians end where they are 1/255, not earlier and at zero.
  gsplatCommonVS: [['min(1.0, sqrt(', 'min(1.2, sqrt(']],
  gsplatPS: [
    ['if (A > 1.0)', 'if (A > 1.44)'],
    ['(exp(x * -4.0) - EXP4) * INV_EXP4', 'exp(x * -4.0)'],
  ],
};

/**
 * Draw splats as INRIA's renderer and `flexgs-edge render` do, with WebGL2: the engine draws them smaller, and leaves small ones out. Call it
 * before anything is drawn.
 *
 * @param {import('playcanvas').AppBase} app
 */
export function drawLikeRender(app, antialiased = false) {
  const options = { minPixelSize: 0, minContribution: 0, dataFormat: GSPLATDATA_LARGE, useTonemap: false };
  Object.assign(app.scene.gsplat, { ...options, antiAlias: antialiased });
  const chunks = ShaderChunks.get(app.graphicsDevice, SHADERLANGUAGE_GLSL);
  for (const [name, changes] of Object.entries(CHANGES)) {
    if (chunks.get(name)?.startsWith(CHANGED)) continue; // for another scene of the application
    const changed = changes.reduce((text, [old, made]) => {
      if (!text?.includes(old)) throw new Error('This version of PlayCanvas has other shaders: take 2.23.');
      return text.replaceAll(old, made);
    }, chunks.get(name));
    chunks.set(name, CHANGED + changed);
  }
}
