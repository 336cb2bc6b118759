/** Bytes for a message, in few words: in the place of `shown-bytes.js`, for a page. */
export function shownBytes(bytes) {
  return bytes.join(' ');
}
