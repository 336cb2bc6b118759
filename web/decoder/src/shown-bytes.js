// Bytes in messages, written as the program (Python) writes them.

export const ESCAPES = { 9: '\\t', 10: '\\n', 13: '\\r', 92: '\\\\' };

/** Bytes for a message. */
export function shownBytes(bytes) {
  const quote = bytes.includes(39) && !bytes.includes(34) ? '"' : "'";
  let out = `b${quote}`;
  for (const byte of bytes) {
    if (byte === quote.charCodeAt(0)) out += `\\${quote}`;
    else if (ESCAPES[byte]) out += ESCAPES[byte];
    else if (byte < 32 || byte > 126) out += `\\x${hex(byte, 2)}`;
    else out += String.fromCharCode(byte);
  }
  return out + quote;
}

export function hex(number, digits) {
  return number.toString(16).padStart(digits, '0');
}
