// Loads a .glb with a .spz inside by CesiumJS and prints its attributes as JSON: node load_glb_spz.mjs NODE_MODULES FILE
import fs from 'node:fs';
import { pathToFileURL } from 'node:url';

const [modules, path] = process.argv.slice(2);
const load = async (name) => (await import(pathToFileURL(`${modules}/@cesium/engine/Source/${name}`).href)).default;
// The unpacker takes node's own ways unless it is in a page; the loader asks whether pictures can be WebP.
process.type = 'renderer';
globalThis.self ??= globalThis;
globalThis.Image = class { set src(address) { setTimeout(() => this.onload(), 0); } };

const GltfLoader = await load('Scene/GltfLoader.js');
const Resource = await load('Core/Resource.js');
const loader = new GltfLoader({
    typedArray: new Uint8Array(fs.readFileSync(path)), gltfResource: new Resource({ url: 'http://localhost/a.glb' }),
    loadAttributesAsTypedArray: true,
});
await loader.load();
const frame = { context: {}, afterRender: [], jobScheduler: { execute: () => true } };
while (!loader.process(frame)) await new Promise((done) => setTimeout(done, 5));
const [node] = loader.components.scene.nodes;
const found = Object.fromEntries(node.primitives[0].attributes.map(({ name, typedArray }) => [name, Array.from(typedArray)]));
fs.writeSync(1, JSON.stringify({ matrix: Object.values(node.matrix), ...found }));
process.exit(0);
