/** What is wrong with a file: the byte where it was noticed, what was wanted and what was found. */
export class FgsError extends Error {
  /**
   * @param {string} name the file, or "" if it has no name
   * @param {number} offset byte of the file
   * @param {string} message
   */
  constructor(name, offset, message) {
    super(`${name ? `${name}: ` : ''}byte ${offset}: ${message}`);
    this.name = 'FgsError';
    this.offset = offset;
  }
}

/** A header that breaks the format; `open` makes an `FgsError` of it. */
export class HeaderError extends Error {}

/** A stream that no encoder writes; `open` and `chunks` make an `FgsError` of it. */
export class StreamError extends Error {}

/** A stream whose bytes end too early: an error, or a sign to wait for more. */
export class ShortStream extends StreamError {
  constructor() {
    super('stream: wanted more words, got its end');
  }
}
