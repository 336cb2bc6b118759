import { HeaderError } from './errors.js';
import { shown } from './shown.js';

/** An integer of a header within its bounds, as a number. */
export function checkedInteger(name, value, lowest, highest) {
  if (typeof value !== 'bigint' || value < BigInt(lowest) || value > BigInt(highest)) {
    throw new HeaderError(`${name}: wanted an integer from ${lowest} to ${highest}, got ${shown(value)}`);
  }
  return Number(value);
}

/** A list of integers within the same bounds. */
export function checkedIntegers(name, value, lowest, highest) {
  if (!Array.isArray(value)) throw new HeaderError(`${name}: wanted a list of integers, got ${shown(value)}`);
  return value.map((number) => checkedInteger(name, number, lowest, highest));
}

/** Three finite numbers with a decimal point or an exponent. */
export function checkedOrigin(value) {
  if (Array.isArray(value) && value.length === 3 && value.every(isFloat)) return value;
  throw new HeaderError(`origin: wanted three finite numbers with a decimal point, got ${shown(value)}`);
}

/** Whether a value of a header is a finite number that was not written as an integer. */
export function isFloat(value) {
  return typeof value === 'number' && Number.isFinite(value);
}

/** Whether a value is an object with exactly these keys, which are sorted. */
export function hasKeys(value, keys) {
  if (!(value instanceof Map)) return false;
  const found = [...value.keys()].sort();
  return found.length === keys.length && keys.every((key, i) => key === found[i]);
}
