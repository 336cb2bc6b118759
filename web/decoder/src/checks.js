import { HeaderError } from './errors.js';
import { plain } from './json.js';
import { LARGEST } from './limits.js';
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

/** Check the contraction of a header. */
export function checkedContraction(value) {
  if (hasKeys(value, ['centre', 'radius']) && Array.isArray(value.get('centre'))) {
    const numbers = [...value.get('centre'), value.get('radius')];
    const known = numbers.length === 4 && numbers.every((number) => isFloat(number) && Math.abs(number) <= LARGEST);
    if (known && value.get('radius') >= 1 / LARGEST) return plain(value);
  }
  throw new HeaderError(
    'contraction: wanted an object with centre (three numbers with a decimal point, within +-2^126) and radius (2^-126 to ' +
      `2^126), got ${shown(value)}`,
  );
}
