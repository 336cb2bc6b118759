// Values in messages, written as the program (Python) writes them, so that both say the same words.
import { ESCAPES, hex } from './shown-bytes.js';

const MOST = 80;

/** A value of a header for a message, cut to 80 characters. */
export function shown(value) {
  if (typeof value === 'bigint' && (value >= 10n ** 40n || value <= -(10n ** 40n))) {
    return 'an integer of more than 40 digits';
  }
  const text = repr(value);
  return text.length <= MOST ? text : `${text.slice(0, MOST - 3)}...`;
}

function repr(value) {
  if (value === null) return 'None';
  if (value === true) return 'True';
  if (value === false) return 'False';
  if (typeof value === 'bigint') return String(value);
  if (typeof value === 'number') return shownFloat(value);
  if (typeof value === 'string') return reprText(value);
  if (Array.isArray(value)) return `[${value.map(repr).join(', ')}]`;
  const pairs = [...value].map(([key, inner]) => `${reprText(key)}: ${repr(inner)}`);
  return `{${pairs.join(', ')}}`;
}

/** A float with the fewest digits that read back to the same number; an exponent below 1e-4 and from 1e16 on. */
export function shownFloat(value) {
  if (Number.isNaN(value)) return 'nan';
  if (!Number.isFinite(value)) return value < 0 ? '-inf' : 'inf';
  const sign = value < 0 || Object.is(value, -0) ? '-' : '';
  const [mantissa, power] = Math.abs(value).toExponential().split('e');
  const places = mantissa.replace('.', '');
  const exponent = Number(power);
  if (exponent < -4 || exponent >= 16) {
    const size = String(Math.abs(exponent)).padStart(2, '0');
    return `${sign}${mantissa}e${exponent < 0 ? '-' : '+'}${size}`;
  }
  if (exponent < 0) return `${sign}0.${'0'.repeat(-exponent - 1)}${places}`;
  const whole = places.padEnd(exponent + 1, '0');
  return `${sign}${whole.slice(0, exponent + 1)}.${whole.slice(exponent + 1) || '0'}`;
}

function reprText(text) {
  const quote = text.includes("'") && !text.includes('"') ? '"' : "'";
  let out = quote;
  for (const letter of text) {
    const code = letter.codePointAt(0);
    if (letter === quote) out += `\\${letter}`;
    else if (ESCAPES[code]) out += ESCAPES[code];
    else if (code < 32 || code === 127 || (code >= 128 && code < 161)) out += `\\x${hex(code, 2)}`;
    else if (code >= 0xd800 && code < 0xe000) out += `\\u${hex(code, 4)}`;
    else out += letter;
  }
  return out + quote;
}
