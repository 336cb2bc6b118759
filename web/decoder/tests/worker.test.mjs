import assert from 'node:assert/strict';
import { readFileSync } from 'node:fs';
import { test } from 'node:test';
import { open } from '../src/index.js';
import { FgsError, openInWorker } from '../src/worker-client.js';
import { serve } from '../src/worker-serve.js';

const bytes = new Uint8Array(readFileSync(new URL('vectors/three_chunks_of_512_rows_in_two_layers.fgs', import.meta.url)));

function served() {
  const { port1, port2 } = new MessageChannel();
  serve(port1);
  return port2;
}

test('a worker gives the same chunks', async () => {
  const here = await open(bytes);
  const there = await openInWorker(bytes, { worker: served() });
  assert.equal(there.count, here.count);
  assert.deepEqual(there.header, here.header);
  const wanted = [];
  for await (const chunk of here.chunks()) wanted.push(chunk);
  let at = 0;
  for await (const chunk of there.chunks({ values: true })) {
    assert.deepEqual(chunk.values, wanted[at].values());
    assert.equal(chunk.rows, wanted[at++].rows);
  }
  assert.equal(at, wanted.length);
  at = 0;
  for await (const chunk of there.chunks({ layers: 1 })) assert.deepEqual(chunk.codes, wanted[at++].codes);
  assert.ok(at > 0 && at < wanted.length);
  await there.close();
});

test('errors of a worker are errors of the format, with the byte', async () => {
  const bad = bytes.slice();
  bad[40] ^= 1;
  await assert.rejects(openInWorker(bad, { worker: served(), name: 'a.fgs' }), (error) => {
    assert.ok(error instanceof FgsError);
    assert.equal(error.offset, 36);
    return /^a\.fgs: byte 36: header: checksum/.test(error.message);
  });
  const late = bytes.slice();
  late[late.length - 60] ^= 1;
  const file = await openInWorker(late, { worker: served() });
  await assert.rejects(async () => {
    for await (const chunk of file.chunks()) assert.ok(chunk.rows);
  }, FgsError);
  await file.close();
});
