// Version 2: codes on one grid, entropy coded.

import { decodeChunk } from './chunk.js';
import { FgsError, StreamError } from './errors.js';
import { decodeHeader2 } from './header2.js';
import { readModel } from './model.js';
import { leastBytes, planChunks2, wrongSize2 } from './plan2.js';
import { values2 } from './values.js';

/** What `formats.js` asks of a version. */
export const VERSION2 = {
  decodeHeader: decodeHeader2,
  wrongSize: wrongSize2,
  planChunks: planChunks2,
  shared: ({ modelOffset, modelBytes }) => ({ part: 'model', offset: modelOffset, length: modelBytes + 4 }),
  readShared(name, body, header) {
    try {
      return readModel(body, header);
    } catch (error) {
      if (error instanceof StreamError) throw new FgsError(name, header.modelOffset, `model: ${error.message}`);
      throw error;
    }
  },
  wrongLength(place, length) {
    const least = leastBytes(place.rows);
    return length < least || length % 2 ? `an even ${least} or more` : '';
  },
  decode({ header, shared }, place, bytes, options) {
    const { codes, used } = decodeChunk(shared, header.low, place.rows, bytes, options);
    return { codes, used, values: () => values2(codes, header) };
  },
};
