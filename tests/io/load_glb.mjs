// Loads a .glb by PlayCanvas and by three.js, and prints their values as JSON: node load_glb.mjs NODE_MODULES FILE
import fs from 'node:fs';
import { pathToFileURL } from 'node:url';

const [modules, path] = process.argv.slice(2);
const load = (name) => import(pathToFileURL(`${modules}/${name}`).href);
const bytes = new Uint8Array(fs.readFileSync(path));
globalThis.self ??= globalThis;
console.warn = () => {};
console.log = () => {};

async function playcanvas() {
    const root = 'playcanvas/build/playcanvas/src';
    const { NullGraphicsDevice } = await load(`${root}/index.js`);
    const { GlbParser } = await load(`${root}/framework/parsers/glb-parser.js`);
    const { khrGaussianSplatting } = await load(`${root}/framework/parsers/glb/extensions/khr-gaussian-splatting.js`);
    const canvas = { width: 4, height: 4, addEventListener() {}, removeEventListener() {} };
    const result = await new Promise((done, fail) => {
        const device = new NullGraphicsDevice(canvas);
        GlbParser.parse('scene.glb', '', bytes, device, { loader: {} }, {}, [khrGaussianSplatting], (error, made) =>
            error ? fail(error) : done(made));
    });
    const data = result.gsplats[0][0].gsplatData;
    return Object.fromEntries(data.elements[0].properties.map(({ name, storage }) => [name, Array.from(storage)]));
}

async function three() {
    const { GLTFLoader } = await load('three/examples/jsm/loaders/GLTFLoader.js');
    const { GLTFGaussianSplatLoaderExtension } = await load('three/examples/jsm/loaders/GLTFGaussianSplatLoaderExtension.js');
    const loader = new GLTFLoader().register((parser) => new GLTFGaussianSplatLoaderExtension(parser));
    const { scene } = await loader.parseAsync(bytes.slice().buffer, '');
    let found;
    scene.traverse((object) => { found ??= object.isGaussianSplat ? object.splatGeometry : undefined; });
    return Object.fromEntries(Object.entries(found.attributes).map(([name, values]) => [name, Array.from(values.array)]));
}

async function validated() {
    const { validateBytes } = (await load('gltf-validator/index.js')).default;
    return (await validateBytes(bytes)).issues.messages;
}

const found = { playcanvas: await playcanvas(), three: await three(), validated: await validated() };
fs.writeSync(1, JSON.stringify(found));
process.exit(0);
