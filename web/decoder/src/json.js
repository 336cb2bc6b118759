import { HeaderError } from './errors.js';
import { shown } from './shown.js';

/** As deep as any parser of the program goes. */
const DEEPEST = 900;
/** Longer integers take quadratic time, and no header has any. */
const DIGITS_MOST = 4300;
/** Texts, with the colon behind keys; numbers; what Python takes for numbers; brackets. A text without an end goes to the end. */
const TOKEN =
  /"[^"\\]*(?:\\[^][^"\\]*)*"?([ \t\n\r]*:)?|-?(?:0|[1-9]\d*)(\.\d+)?([eE][-+]?\d+)?|NaN|-?Infinity|[[\]{}]/g;

/**
 * Strict JSON of a header. The engine's own parser takes a repeated key, and does not tell 1 from 1.0: so each key gets a number
 * before it is parsed, and integers become texts.
 *
 * @param {Uint8Array} bytes ASCII
 * @returns {any} objects are Maps, integers BigInts, other numbers numbers
 */
export function parseJson(bytes) {
  const beyond = bytes.findIndex((byte) => byte > 127);
  if (beyond >= 0) fail(`byte 0x${bytes[beyond].toString(16)} in position ${beyond}`);
  let depth = 0;
  let keys = 0;
  let infinite = null;
  const marked = new TextDecoder('latin1').decode(bytes).replace(TOKEN, (token, colon, fraction, exponent) => {
    const first = token[0];
    if (first === '"') return `"${colon ? `k${keys++}:` : 's'}${token.slice(1)}`;
    if (first === '[' || first === '{') depth++;
    if (first === ']' || first === '}') depth--;
    if (depth > DEEPEST) throw new HeaderError('wanted JSON, got values nested too deep');
    if (/[yN]$/.test(token)) {
      infinite ??= token;
      return 'null';
    }
    if (!/\d$/.test(token) || fraction || exponent) return token;
    if (token.length > DIGITS_MOST) fail('an integer of very many digits');
    return `"i${token}"`;
  });
  let value;
  try {
    value = JSON.parse(marked, (_, inner) => unmarked(inner));
  } catch (error) {
    if (error instanceof SyntaxError) fail('something else');
    throw error;
  }
  if (infinite) throw new HeaderError(`wanted finite numbers, got ${infinite}`);
  return value;
}

function fail(text) {
  throw new HeaderError(`wanted JSON in ASCII, got ${text}`);
}

function unmarked(value) {
  if (typeof value === 'string') return value[0] === 'i' ? BigInt(value.slice(1)) : value.slice(1);
  if (value === null || typeof value !== 'object' || Array.isArray(value)) return value;
  const record = new Map();
  for (const [marked, inner] of Object.entries(value)) {
    // Without a mark, it was a number in the place of a key.
    if (marked[0] !== 'k') fail('something else');
    const key = marked.slice(marked.indexOf(':') + 1);
    if (record.has(key)) throw new HeaderError(`wanted each key once, got ${shown(key)} twice`);
    record.set(key, inner);
  }
  return record;
}

/** Plain objects and numbers, for a caller: of an integer beyond 2^53 only the size is kept. */
export function plain(value) {
  if (typeof value === 'bigint') return Number(value);
  if (Array.isArray(value)) return value.map(plain);
  if (!(value instanceof Map)) return value;
  // A key "__proto__" must stay a key.
  return Object.fromEntries([...value].map(([key, inner]) => [key, plain(inner)]));
}
