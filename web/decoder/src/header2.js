import { checkedContraction, checkedInteger, checkedIntegers, checkedOrigin, hasKeys, isFloat } from './checks.js';
import { HeaderError } from './errors.js';
import { parseJson, plain } from './json.js';
import {
  CHUNK_ROWS,
  CODE_LIMIT,
  COUNT_MOST,
  DEGREE_MOST,
  DEPTH_MOST,
  LAYERS_MOST,
  MODEL_MOST,
  PREAMBLE_BYTES,
  PREVIEW_MOST,
} from './limits.js';
import { shown } from './shown.js';

const HEADER_KEYS = [
  'chunk_rows',
  'count',
  'cut_from',
  'depth',
  'layers',
  'low',
  'model_bytes',
  'origin',
  'settings',
  'sh_degree',
  'steps',
];
const OPTIONAL_KEYS = ['channels', 'preview_bytes'];
const STEP_KEYS = ['chroma', 'dc', 'opacity', 'position', 'rotation', 'scale', 'sh'];
/** As the program words it: the order in which it looks at them. */
const STEP_ORDER = ['position', 'scale', 'rotation', 'opacity', 'dc', 'sh', 'chroma'];

/** Read and check the header of a version 2 file; throws `HeaderError`. */
export function decodeHeader2(bytes) {
  const record = parseJson(bytes);
  const known = record instanceof Map ? OPTIONAL_KEYS.filter((key) => record.has(key)) : [];
  if (!hasKeys(record, [...HEADER_KEYS, ...known].sort())) {
    const [keys, others] = [HEADER_KEYS, OPTIONAL_KEYS].map((some) => some.join(', '));
    throw new HeaderError(`wanted an object with the keys ${keys} and perhaps ${others}, got ${shown(record)}`);
  }
  const count = checkedInteger('count', record.get('count'), 0, COUNT_MOST);
  const layers = checkedIntegers('layers', record.get('layers'), 0, COUNT_MOST);
  if (layers.length < 1 || layers.length > LAYERS_MOST || layers.reduce((a, b) => a + b, 0) !== count) {
    const found = shown(record.get('layers'));
    throw new HeaderError(`layers: wanted 1 to ${LAYERS_MOST} counts that add up to ${count}, got ${found}`);
  }
  const low = checkedIntegers('low', record.get('low'), -CODE_LIMIT, CODE_LIMIT);
  if (low.length !== 3) throw new HeaderError(`low: wanted three integers, got ${shown(record.get('low'))}`);
  const settings = record.get('settings');
  if (!(settings instanceof Map)) throw new HeaderError(`settings: wanted an object, got ${shown(settings)}`);
  const shDegree = checkedInteger('sh_degree', record.get('sh_degree'), 0, DEGREE_MOST);
  const origin = checkedOrigin(record.get('origin'));
  const steps = checkedSteps(record.get('steps'), shDegree);
  const chunkRows = checkedInteger('chunk_rows', record.get('chunk_rows'), 1, CHUNK_ROWS);
  const depth = checkedInteger('depth', record.get('depth'), 0, DEPTH_MOST);
  const modelBytes = checkedInteger('model_bytes', record.get('model_bytes'), 0, MODEL_MOST);
  const cutFrom = checkedCut(record.get('cut_from'));
  const channels = record.has('channels') ? checkedChannels(record.get('channels'), count, shDegree) : null;
  const previewBytes = known.includes('preview_bytes')
    ? checkedInteger('preview_bytes', record.get('preview_bytes'), 1, PREVIEW_MOST)
    : 0;
  const chunkCount = layers.reduce((sum, rows) => sum + Math.ceil(rows / chunkRows), 0);
  const modelOffset = PREAMBLE_BYTES + bytes.length;
  return {
    version: 2,
    count,
    shDegree,
    origin,
    settings: plain(settings),
    layers,
    low,
    steps,
    chunkRows,
    depth,
    cutFrom,
    channels,
    chunkCount,
    modelOffset,
    modelBytes,
    previewBytes,
    chunksOffset: modelOffset + modelBytes + 4 + previewBytes,
    tableBytes: 8 * chunkCount + 4,
  };
}

function checkedSteps(value, shDegree) {
  const contracted = value instanceof Map && value.has('contraction');
  if (!hasKeys(value, contracted ? [...STEP_KEYS, 'contraction'].sort() : STEP_KEYS)) {
    const keys = STEP_KEYS.join(', ');
    throw new HeaderError(`steps: wanted an object with the keys ${keys} and perhaps contraction, got ${shown(value)}`);
  }
  const sh = value.get('sh');
  if (!Array.isArray(sh) || sh.length !== shDegree) {
    throw new HeaderError(`steps.sh: wanted ${shDegree} numbers, got ${shown(sh)}`);
  }
  const numbers = [...STEP_KEYS.slice(0, -1).map((name) => value.get(name)), ...sh];
  if (!numbers.every(isFloat)) {
    throw new HeaderError(`steps: wanted finite numbers with a decimal point, got ${shown(value)}`);
  }
  if (contracted) checkedContraction(value.get('contraction'));
  for (const name of STEP_ORDER) {
    const most = name === 'chroma' ? 16 : 80;
    const some = name === 'sh' ? sh : [value.get(name)];
    if (!some.every((number) => inRange(Math.fround(number), 2 ** -most, 2 ** most))) {
      const bounds = `2^-${most} to 2^${most}`;
      const got = name === 'sh' ? tuple(sh) : shown(value.get(name));
      throw new HeaderError(`steps: step of ${name}: expected positive numbers from ${bounds}, got ${got}`);
    }
  }
  if (numbers.some((number) => Math.fround(number) !== number)) {
    throw new HeaderError(`steps: wanted float32 numbers, got ${shown(value)}`);
  }
  return plain(value);
}

function inRange(number, lowest, highest) {
  return number >= lowest && number <= highest;
}

function tuple(list) {
  const inner = list.map((number) => shown(number)).join(', ');
  return list.length === 1 ? `(${inner},)` : `(${inner})`;
}

function checkedCut(value) {
  if (value === null) return null;
  if (!hasKeys(value, ['bytes', 'count', 'layers'])) {
    const wanted = 'null or an object with bytes, count and layers';
    throw new HeaderError(`cut_from: wanted ${wanted}, got ${shown(value)}`);
  }
  const most = 2n ** 63n - 1n;
  const [bytes, count, layers] = ['bytes', 'count', 'layers'].map((name) =>
    checkedInteger(`cut_from.${name}`, value.get(name), 0, most),
  );
  return { bytes, count, layers };
}

function checkedChannels(value, count, shDegree) {
  if (!hasKeys(value, ['bytes', 'rows'])) {
    throw new HeaderError(`channels: wanted an object with bytes and rows, got ${shown(value)}`);
  }
  const bytes = checkedIntegers('channels.bytes', value.get('bytes'), 0, Number.MAX_SAFE_INTEGER);
  const rows = checkedIntegers('channels.rows', value.get('rows'), 0, count);
  if (bytes.length !== 6 + shDegree || rows.length !== shDegree) {
    const wanted = `${6 + shDegree} bytes and ${shDegree} rows`;
    throw new HeaderError(`channels: wanted ${wanted}, got ${shown(value)}`);
  }
  return { bytes, rows };
}
