import { HeaderError } from './errors.js';
import {
  CHUNK_ROWS,
  CODE_LIMIT,
  COUNT_MOST,
  DEGREE_MOST,
  DEPTH_MOST,
  LARGEST,
  LAYERS_MOST,
  MODEL_MOST,
  PREAMBLE_BYTES,
  PREVIEW_MOST,
} from './limits.js';

/**
 * `decodeHeader2` in few words, in the place of `header2.js`, for a page. It refuses the same values, but takes 1 for 1.0, 1.0 for 1
 * and a key twice, and does not tell what is wrong.
 */
export function decodeHeader2(bytes) {
  const record = parsed(bytes);
  const { chunk_rows: chunkRows, count, cut_from: cutFrom, depth, layers, low, model_bytes: modelBytes } = record;
  const { origin, settings, sh_degree: shDegree, steps, channels, preview_bytes: previewBytes = 0 } = record;
  const keys = 'chunk_rows count cut_from depth layers low model_bytes origin settings sh_degree steps';
  const right =
    hasKeys(record, keys, ['channels', 'preview_bytes']) &&
    isWhole(count, 0, COUNT_MOST) &&
    areWhole(layers, layers?.length, 0, COUNT_MOST) && layers.length <= LAYERS_MOST && sum(layers) === count &&
    areWhole(low, 3, -CODE_LIMIT, CODE_LIMIT) &&
    isObject(settings) &&
    isWhole(shDegree, 0, DEGREE_MOST) &&
    isList(origin, 3, Number.isFinite) &&
    areSteps(steps, shDegree) &&
    isWhole(chunkRows, 1, CHUNK_ROWS) &&
    isWhole(depth, 0, DEPTH_MOST) &&
    isWhole(modelBytes, 0, MODEL_MOST) &&
    (cutFrom === null || isCut(cutFrom)) &&
    (channels === undefined || areChannels(channels, count, shDegree)) &&
    isWhole(previewBytes, 'preview_bytes' in record ? 1 : 0, PREVIEW_MOST);
  if (!right) fail();
  const chunkCount = sum(layers.map((rows) => Math.ceil(rows / chunkRows)));
  const modelOffset = PREAMBLE_BYTES + bytes.length;
  return {
    version: 2,
    count,
    shDegree,
    origin,
    settings,
    layers,
    low,
    steps,
    chunkRows,
    depth,
    cutFrom,
    channels: channels ?? null,
    chunkCount,
    modelOffset,
    modelBytes,
    previewBytes,
    chunksOffset: modelOffset + modelBytes + 4 + previewBytes,
    tableBytes: 8 * chunkCount + 4,
  };
}

function parsed(bytes) {
  let value;
  try {
    value = bytes.every((byte) => byte < 128) && JSON.parse(new TextDecoder('latin1').decode(bytes));
  } catch {
    // Said below.
  }
  if (isObject(value)) return value;
  return fail();
}

function fail() {
  throw new HeaderError('not as flexgs-edge writes it');
}

function sum(list) {
  return list.reduce((total, value) => total + value, 0);
}

function isObject(value) {
  return typeof value === 'object' && value !== null && !Array.isArray(value);
}

/** Whether a value is an object with these keys, and perhaps some others. */
function hasKeys(value, keys, others = []) {
  return isObject(value) && Object.keys(value).filter((key) => !others.includes(key)).sort().join(' ') === keys;
}

function isList(value, length, test) {
  return Array.isArray(value) && value.length === length && value.every((each) => test(each));
}

function isWhole(value, lowest, highest) {
  return Number.isInteger(value) && value >= lowest && value <= highest;
}

function areWhole(value, length, lowest, highest) {
  return isList(value, length, (each) => isWhole(each, lowest, highest));
}

function areSteps(value, shDegree) {
  if (!hasKeys(value, 'chroma dc opacity position rotation scale sh', ['contraction'])) return false;
  const { chroma, dc, opacity, position, rotation, scale, sh, contraction } = value;
  const isStep = (step, octaves = 80) => Math.fround(step) === step && step >= 2 ** -octaves && step <= 2 ** octaves;
  const others = isList([dc, opacity, position, rotation, scale], 5, isStep) && isList(sh, shDegree, isStep);
  return others && isStep(chroma, 16) && (contraction === undefined || isContraction(contraction));
}

function isContraction(value) {
  if (!hasKeys(value, 'centre radius')) return false;
  const { centre, radius } = value;
  const isNear = (number) => Number.isFinite(number) && Math.abs(number) <= LARGEST;
  return isList(centre, 3, isNear) && isNear(radius) && radius >= 1 / LARGEST;
}

function isCut(value) {
  return hasKeys(value, 'bytes count layers') && areWhole(Object.values(value), 3, 0, 2 ** 63);
}

function areChannels(value, count, shDegree) {
  if (!hasKeys(value, 'bytes rows')) return false;
  return areWhole(value.bytes, 6 + shDegree, 0, Number.MAX_SAFE_INTEGER) && areWhole(value.rows, shDegree, 0, count);
}
