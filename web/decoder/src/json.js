import { HeaderError } from './errors.js';
import { shown } from './shown.js';

/** As deep as any parser of the program goes. */
const DEEPEST = 900;
const NUMBER = /-?(?:0|[1-9]\d*)(\.\d+)?([eE][-+]?\d+)?/y;
const WORDS = { null: null, true: true, false: false };
const CONSTANTS = ['NaN', 'Infinity', '-Infinity'];
const ESCAPED = { '"': '"', '\\': '\\', '/': '/', b: '\b', f: '\f', n: '\n', r: '\r', t: '\t' };

/**
 * Strict JSON of a header. The engine's own parser takes a repeated key, and does not tell 1 from 1.0.
 *
 * @param {Uint8Array} bytes ASCII
 * @returns {any} objects are Maps, integers BigInts, other numbers numbers
 */
export function parseJson(bytes) {
  const beyond = bytes.findIndex((byte) => byte > 127);
  if (beyond >= 0) {
    const byte = bytes[beyond].toString(16);
    fail(`'ascii' codec can't decode byte 0x${byte} in position ${beyond}: ordinal not in range(128)`);
  }
  return new Parser(new TextDecoder('latin1').decode(bytes)).whole();
}

function fail(text) {
  throw new HeaderError(`wanted JSON in ASCII, got ${text}`);
}

class Parser {
  constructor(text) {
    this.text = text;
    this.at = 0;
    this.depth = 0;
  }

  whole() {
    this.space();
    const value = this.value();
    this.space();
    if (this.at < this.text.length) this.wrong('Extra data');
    return value;
  }

  wrong(what, at = this.at) {
    const before = this.text.slice(0, at);
    const line = before.split('\n').length;
    fail(`${what}: line ${line} column ${at - before.lastIndexOf('\n')} (char ${at})`);
  }

  space() {
    while (' \t\n\r'.includes(this.text[this.at] ?? 'x')) this.at++;
  }

  value() {
    const letter = this.text[this.at];
    if (letter === '"') return this.string();
    if (letter === '{' || letter === '[') {
      if (++this.depth > DEEPEST) throw new HeaderError('wanted JSON, got values nested too deep');
      const value = letter === '{' ? this.object() : this.array();
      this.depth--;
      return value;
    }
    for (const word in WORDS) {
      if (this.text.startsWith(word, this.at)) {
        this.at += word.length;
        return WORDS[word];
      }
    }
    for (const word of CONSTANTS) {
      if (this.text.startsWith(word, this.at)) throw new HeaderError(`wanted finite numbers, got ${word}`);
    }
    NUMBER.lastIndex = this.at;
    const found = NUMBER.exec(this.text);
    if (!found) this.wrong('Expecting value');
    this.at += found[0].length;
    if (found[1] || found[2]) return Number(found[0]);
    // Longer ones take quadratic time, and no header has any.
    if (found[0].length > 4300) fail('an integer of very many digits');
    return BigInt(found[0]);
  }

  object() {
    const record = new Map();
    let twice = null;
    this.at++;
    this.space();
    if (this.text[this.at] === '}') {
      this.at++;
      return record;
    }
    for (;;) {
      if (this.text[this.at] !== '"') this.wrong('Expecting property name enclosed in double quotes');
      const key = this.string();
      this.space();
      if (this.text[this.at] !== ':') this.wrong("Expecting ':' delimiter");
      this.at++;
      this.space();
      const value = this.value();
      if (record.has(key)) twice ??= key;
      record.set(key, value);
      this.space();
      if (this.text[this.at] === '}') break;
      if (this.text[this.at] !== ',') this.wrong("Expecting ',' delimiter");
      this.at++;
      this.space();
    }
    this.at++;
    if (twice !== null) throw new HeaderError(`wanted each key once, got ${shown(twice)} twice`);
    return record;
  }

  array() {
    const list = [];
    this.at++;
    this.space();
    if (this.text[this.at] === ']') {
      this.at++;
      return list;
    }
    for (;;) {
      list.push(this.value());
      this.space();
      if (this.text[this.at] === ']') break;
      if (this.text[this.at] !== ',') this.wrong("Expecting ',' delimiter");
      this.at++;
      this.space();
    }
    this.at++;
    return list;
  }

  string() {
    const start = this.at++;
    let out = '';
    for (;;) {
      const letter = this.text[this.at];
      if (letter === undefined) this.wrong('Unterminated string starting at', start);
      if (letter === '"') break;
      if (letter < ' ') this.wrong('Invalid control character at');
      if (letter !== '\\') {
        out += letter;
        this.at++;
        continue;
      }
      const escape = this.text[this.at + 1];
      if (escape === undefined) this.wrong('Unterminated string starting at', start);
      if (escape === 'u') {
        const digits = this.text.slice(this.at + 2, this.at + 6);
        if (!/^[0-9a-fA-F]{4}$/.test(digits)) this.wrong('Invalid \\uXXXX escape', this.at + 1);
        out += String.fromCharCode(parseInt(digits, 16));
        this.at += 6;
      } else {
        if (!(escape in ESCAPED)) this.wrong('Invalid \\escape', this.at);
        out += ESCAPED[escape];
        this.at += 2;
      }
    }
    this.at++;
    return out;
  }
}

/** Plain objects and numbers, for a caller: of an integer beyond 2^53 only the size is kept. */
export function plain(value) {
  if (typeof value === 'bigint') return Number(value);
  if (Array.isArray(value)) return value.map(plain);
  if (!(value instanceof Map)) return value;
  // A key "__proto__" must stay a key.
  return Object.fromEntries([...value].map(([key, inner]) => [key, plain(inner)]));
}
