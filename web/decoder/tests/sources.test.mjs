import assert from 'node:assert/strict';
import { createReadStream, readFileSync } from 'node:fs';
import { createServer } from 'node:http';
import { relative } from 'node:path';
import { test } from 'node:test';
import { fileURLToPath } from 'node:url';
import { FgsError, looksLikeFgs, open, openPreview, prefetch } from '../src/index.js';
import { readAll, streamOf } from './read.mjs';

const NAME = 'three_chunks_of_512_rows_in_two_layers.fgs';
const FOLDER = new URL('vectors/', import.meta.url);
const bytes = new Uint8Array(readFileSync(new URL(NAME, FOLDER)));
const wanted = JSON.parse(readFileSync(new URL('vectors.json', FOLDER), 'utf8'))[NAME];

/** `ranges`: 'all', 'no' ranges, or none that count from the 'end'. `cut`: the byte at which answers to ranges stop. */
async function withServer(ranges, use, cut = Infinity) {
  const asked = [];
  const server = createServer((request, response) => {
    const range = /^bytes=(\d*)-(\d*)$/.exec(request.headers.range ?? '');
    asked.push(request.headers.range);
    if (request.url !== '/scene.fgs') return response.writeHead(404).end();
    if (ranges === 'no' || !range || (ranges === 'end' && !range[1])) return response.writeHead(200).end(bytes);
    const first = range[1] ? Number(range[1]) : Math.max(bytes.length - Number(range[2]), 0);
    const last = range[1] && range[2] ? Math.min(Number(range[2]), bytes.length - 1) : bytes.length - 1;
    response.writeHead(206, { 'Content-Range': `bytes ${first}-${last}/${bytes.length}` });
    return response.end(bytes.subarray(first, Math.min(last + 1, Math.max(cut, first))));
  });
  await new Promise((ready) => server.listen(0, '127.0.0.1', ready));
  try {
    await use(`http://127.0.0.1:${server.address().port}/scene.fgs`, asked);
  } finally {
    server.closeAllConnections?.();
    server.close();
  }
}

for (const ranges of ['all', 'end', 'no']) {
  test(`an address on a server with ranges: ${ranges}`, () =>
    withServer(ranges, async (url, asked) => {
      assert.deepEqual(await readAll(ranges === 'no' ? new URL(url) : url), wanted);
      assert.ok(asked.every((range) => range) && asked.length === 2, asked.join());
    }));
}

const ends = (url, first, last) => ({ url, size: bytes.length, first: bytes.slice(0, first), last: bytes.slice(bytes.length - last) });

test('between its ends a file comes in one range, whatever the ends are', () =>
  withServer('all', async (url, asked) => {
    for (const [first, last] of [
      [5000, 36],
      [5000, 5000],
      [20, 0],
      [0, 36],
    ]) {
      asked.length = 0;
      assert.deepEqual(await readAll(ends(url, first, last)), wanted);
      const middle = asked.filter((range) => Number(/-(\d+)$/.exec(range)[1]) > 9000);
      assert.ok(asked.length < 6 && middle.length <= 2, asked.join());
    }
    const file = await open(ends(url, 5000, 36));
    asked.length = 0;
    const seen = [];
    for await (const chunk of file.chunks({ first: 1, layers: 1 })) seen.push(chunk.index);
    assert.deepEqual(seen, [1]);
    assert.equal(asked.length, 1);
    const [from, to] = asked[0].match(/\d+/g).map(Number);
    assert.ok(from > 5000 && to < bytes.length - 4000, asked[0]);
    for await (const chunk of file.chunks()) if (chunk.index === 0) break;
    assert.equal((await open(ends(url, 5000, 36))).count, wanted.count);
  }));

test('any chunk can be had of a source of which any part can be had', () =>
  withServer('all', async (url) => {
    const inOrder = [];
    for await (const chunk of (await open(bytes)).chunks()) inOrder.push(chunk);
    for (const source of [bytes, new Blob([bytes]), url, ends(url, 5000, 36)]) {
      const file = await open(source);
      for (const index of [2, 0]) {
        const { start, layer, rows, codes, verified } = await file.chunk(index);
        const { start: s, layer: l, rows: r, codes: c } = inOrder[index];
        assert.deepEqual([start, layer, rows, codes, verified], [s, l, r, c, true]);
      }
      assert.equal((await file.chunk(1, { sh: false })).codes.sh.length, 0);
      await assert.rejects(file.chunk(inOrder.length), /wanted a chunk from 0 to \d, got \d/);
    }
    assert.equal((await open(streamOf(bytes, 1000))).chunk, undefined);
    const damaged = bytes.slice();
    damaged[damaged.length - 200] ^= 1;
    const file = await open(damaged);
    await assert.rejects(file.chunk(inOrder.length - 1), FgsError);
    assert.equal((await file.chunk(0)).index, 0);
  }));

test('a range that ends early, or a server that changed its mind', async () => {
  await withServer('all', (url) => assert.rejects(readAll(ends(url, 5000, 36)), /wanted \d+ bytes from 5000 on, got 2000/), 7000);
  await withServer('no', (url) => assert.rejects(readAll(ends(url, 5000, 36)), /does not answer to ranges any more/));
});

test('what prefetch gives can be opened', async () => {
  for (const ranges of ['all', 'no']) {
    await withServer(ranges, async (url) => assert.deepEqual(await readAll(await prefetch(url)), wanted));
  }
});

test('a response, and an address that is not there', () =>
  withServer('no', async (url) => {
    assert.deepEqual(await readAll(await fetch(url)), wanted);
    await assert.rejects(open(`${url}x`), /the server says 404/);
  }));

test('chunks of a stream come before its end, unverified', async () => {
  let given = 0;
  const stream = new ReadableStream(
    {
      pull(controller) {
        if (given >= bytes.length) return controller.close();
        controller.enqueue(bytes.slice(given, given + 100));
        given += 100;
      },
    },
    { highWaterMark: 0 },
  );
  const file = await open(stream);
  const seen = [];
  for await (const chunk of file.chunks()) seen.push([chunk.verified, given]);
  assert.equal(seen.length, 4);
  assert.equal(seen[0][0], false);
  assert.ok(seen[0][1] < seen[3][1] && seen[0][1] < bytes.length - 1500, `the first chunk came after ${seen[0][1]} of ${bytes.length} bytes`);
});

test('damage of a stream is told at its end, also where the chunk decodes', async () => {
  for (const at of [bytes.length - 37, bytes.length - 200, Math.floor(bytes.length * 0.6), bytes.length - 1]) {
    const bad = bytes.slice();
    bad[at] ^= 4;
    await assert.rejects(readAll(streamOf(bad, 333)), (error) => error instanceof FgsError && /checksum/.test(error.message));
  }
});

test('a stream that ends early or goes on is refused', async () => {
  await assert.rejects(readAll(streamOf(bytes.subarray(0, bytes.length - 5), 333)), /byte 16: file size: wanted \d+, got \d+/);
  const longer = new Uint8Array(bytes.length + 1000);
  longer.set(bytes);
  const message = new RegExp(`file size: wanted ${bytes.length}, got ${longer.length}: truncated or extended`);
  await assert.rejects(readAll(streamOf(longer, 333)), message);
});

test('a part of a file: layers, first chunks, no SH', async () => {
  const file = await open(bytes);
  const seen = async (options) => {
    const found = [];
    for await (const chunk of file.chunks(options)) found.push(chunk);
    return found;
  };
  const all = await seen({});
  assert.deepEqual((await seen({ layers: 1 })).map((chunk) => chunk.index), [0, 1]);
  assert.deepEqual((await seen({ first: 2 })).map((chunk) => chunk.index), [2, 3]);
  const [bare] = await seen({ sh: false });
  assert.deepEqual(bare.codes.dc, all[0].codes.dc);
  assert.deepEqual(bare.codes.sh, []);
  assert.ok(bare.values().shRest.every((value) => value === 0));
});

test('claims are compared with the size before anything is made', async () => {
  const huge = bytes.slice();
  // A count of rows that the file cannot hold, under correct checksums, is in tests/fuzz/corpus; here the preamble lies.
  new DataView(huge.buffer).setBigUint64(16, 2n ** 60n, true);
  await assert.rejects(open(huge), FgsError);
  await assert.rejects(open(streamOf(huge, 500)), FgsError);
});

test('an interrupted download is an error, not a scene', async () => {
  let given = 0;
  const broken = new ReadableStream({
    pull(controller) {
      if (given > 10_000) return controller.error(new Error('the line is dead'));
      controller.enqueue(bytes.slice(given, given + 1000));
      given += 1000;
    },
  });
  await assert.rejects(readAll(broken), /the line is dead/);
  const short = { size: bytes.length, read: async (offset, length) => bytes.slice(offset, Math.min(offset + length, 12_000)) };
  await assert.rejects(readAll(short), (error) => error instanceof FgsError && /the file is truncated/.test(error.message));
});

test('what is no source is a TypeError', async () => {
  await assert.rejects(open(5), TypeError);
  assert.ok(looksLikeFgs(bytes));
  assert.ok(!looksLikeFgs(bytes.subarray(1)));
});

test('a preview comes before the chunks, and can be opened', async () => {
  const previewed = new Uint8Array(readFileSync(new URL('a_preview_before_chunks_of_256_rows.fgs', FOLDER)));
  const small = new Uint8Array(readFileSync(new URL('255_rows.fgs', FOLDER)));
  for (const given of [previewed, streamOf(previewed, 100)]) {
    const file = await open(given, { name: 'a.fgs' });
    assert.deepEqual(await file.previewBytes(), small);
    const preview = await openPreview(file, 'a.fgs');
    assert.equal(preview.count, 255);
    for await (const chunk of preview.chunks()) assert.ok(chunk.verified);
    let rows = 0;
    for await (const chunk of file.chunks()) rows += chunk.rows;
    assert.equal(rows, file.count);
  }
  assert.equal(await openPreview(await open(bytes)), null);
  await assert.rejects(openPreview({ previewBytes: async () => previewed }), /preview_bytes: wanted none in a preview/);

  const { chunksOffset } = (await open(previewed)).header;
  await assert.rejects(open(streamOf(previewed.subarray(0, chunksOffset - 5), 100)), /preview: wanted .* truncated/);
  previewed[chunksOffset - 3] ^= 1;
  const file = await open(previewed);
  const preview = await openPreview(file, 'a.fgs');
  await assert.rejects(async () => {
    for await (const chunk of preview.chunks()) assert.ok(chunk);
  }, /a\.fgs \(preview\): byte \d+: /);
});

test('in Node: a path, a file address, a stream of its own', async () => {
  const place = new URL(NAME, FOLDER);
  const path = fileURLToPath(place);
  for (const given of [path, relative(process.cwd(), path), place, place.href]) {
    assert.deepEqual(await readAll(given), wanted);
    assert.ok((await open(given)).chunk, 'any chunk can be had');
  }
  assert.deepEqual(await readAll(createReadStream(path)), wanted);
  await assert.rejects(open('no such file.fgs'), { code: 'ENOENT' });
});
