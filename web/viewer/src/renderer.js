import { shPerLine, shTexels, TEXELS, TEXTURE_WIDTH } from './pack.js';
import { FINAL_FRAGMENT, FINAL_VERTEX, SPLAT_FRAGMENT, SPLAT_VERTEX } from './shaders.js';
import { ROW_BITS } from './some.js';

const BESIDE_PREVIEW = 15 / 16;
const EVERYWHERE = [-3e38, 3e38].map((end) => [end, end, end]);

/** Draws splats with WebGL2. */
export class Renderer {
  /** @param {HTMLCanvasElement} canvas */
  constructor(canvas, { half = true } = {}) {
    const gl = canvas.getContext('webgl2', { alpha: false, antialias: false, depth: false, powerPreference: 'high-performance' });
    if (!gl) throw new Error('This page needs WebGL2, which this browser does not give.');
    this.gl = gl;
    this.canvas = canvas;
    // Sums of many faint splats need more than 8 bits.
    this.half = half && Boolean(gl.getExtension('EXT_color_buffer_float') || gl.getExtension('EXT_color_buffer_half_float'));
    this.splats = makeProgram(gl, SPLAT_VERTEX, SPLAT_FRAGMENT);
    this.final = makeProgram(gl, FINAL_VERTEX, FINAL_FRAGMENT);
    this.order = gl.createBuffer();
    this.drawn = 0;
    this.array = gl.createVertexArray();
    gl.bindVertexArray(this.array);
    gl.bindBuffer(gl.ARRAY_BUFFER, this.order);
    gl.enableVertexAttribArray(0);
    gl.vertexAttribIPointer(0, 1, gl.UNSIGNED_INT, 0, 0);
    gl.vertexAttribDivisor(0, 1);
    this.empty = gl.createVertexArray();
    this.target = null;
    this.orderBytes = 0;
  }

  /** Bytes of textures that a scene takes. */
  static bytesOf(header) {
    return header.count * TEXELS * 16 + header.shRows * shTexels(header.shDegree) * 16;
  }

  /** How many rows, and rows with SH, textures have room for beside a preview. */
  most(degree) {
    const lines = this.gl.getParameter(this.gl.MAX_TEXTURE_SIZE) * BESIDE_PREVIEW;
    const count = Math.min((lines * TEXTURE_WIDTH) / TEXELS, 2 ** ROW_BITS * BESIDE_PREVIEW);
    return { count, shRows: lines * shPerLine(degree) };
  }

  /** Make room for a scene. */
  begin(header) {
    const { gl } = this;
    for (const texture of [this.data, this.sh]) if (texture) gl.deleteTexture(texture);
    this.degree = header.shDegree;
    const dataLines = Math.max(1, Math.ceil((header.count * TEXELS) / TEXTURE_WIDTH));
    const shLines = Math.max(1, Math.ceil(header.shRows / shPerLine(header.shDegree)));
    this.data = makeTexture(gl, gl.RGBA32UI, TEXTURE_WIDTH, dataLines);
    this.sh = makeTexture(gl, gl.RGBA32UI, TEXTURE_WIDTH, shLines);
    if (gl.getError() === gl.OUT_OF_MEMORY) throw new Error('The scene does not fit into this device’s memory.');
    this.drawn = 0;
  }

  /** Put a packed chunk into the textures. */
  add({ data, sh, start, shStart, shRows }) {
    const { gl } = this;
    upload(gl, this.data, data, start * TEXELS, TEXTURE_WIDTH);
    const texels = shTexels(this.degree);
    if (shRows) upload(gl, this.sh, sh, shStart * texels, shPerLine(this.degree) * texels);
  }

  /** Call back when the device has done all that it was told: it works on by itself. */
  whenDone(then) {
    const { gl } = this;
    const fence = gl.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
    gl.flush();
    const look = () => {
      if (fence && gl.clientWaitSync(fence, 0, 0) === gl.TIMEOUT_EXPIRED) return setTimeout(look, 1);
      gl.deleteSync(fence);
      return then();
    };
    setTimeout(look, 0);
  }

  /** The rows to draw, back to front. */
  setOrder(order, count) {
    const { gl } = this;
    gl.bindBuffer(gl.ARRAY_BUFFER, this.order);
    if (this.orderBytes < order.byteLength) {
      gl.bufferData(gl.ARRAY_BUFFER, order.byteLength, gl.DYNAMIC_DRAW);
      this.orderBytes = order.byteLength;
    }
    gl.bufferSubData(gl.ARRAY_BUFFER, 0, order, 0, count);
    this.drawn = count;
  }

  /**
   * Draw a frame.
   * @param {object} view from `Camera.view`
   * @param {{near: number, degree: number, antialiased: boolean, background: number[]}} look
   * @param {number} growth factor on all scales
   */
  draw(view, look, growth = 1) {
    const { gl } = this;
    const { width, height } = view;
    this.#makeTarget(width, height);
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.target.frame);
    gl.viewport(0, 0, width, height);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT);
    if (this.drawn) this.#drawSplats(view, look, growth);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.disable(gl.BLEND);
    gl.viewport(0, 0, width, height);
    gl.useProgram(this.final.program);
    bind(gl, 0, this.target.texture, this.final.at('picture'));
    gl.uniform3fv(this.final.at('background'), look.background);
    gl.bindVertexArray(this.empty);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }

  #drawSplats(view, look, growth) {
    const { gl } = this;
    const { program, at } = this.splats;
    gl.useProgram(program);
    bind(gl, 0, this.data, at('data'));
    bind(gl, 1, this.sh, at('sh'));
    // Rows of the rotation, as columns of its transpose.
    gl.uniformMatrix3fv(at('toCamera'), true, view.rotation);
    gl.uniform3fv(at('eye'), view.eye);
    gl.uniform2f(at('focal'), view.fx, view.fy);
    gl.uniform2f(at('middle'), view.cx, view.cy);
    gl.uniform2f(at('size'), view.width, view.height);
    gl.uniform1f(at('near'), look.near);
    gl.uniform1i(at('degree'), Math.min(look.degree, this.degree));
    gl.uniform1i(at('shTexels'), shTexels(this.degree));
    gl.uniform1i(at('shPerLine'), shPerLine(this.degree));
    gl.uniform1i(at('antialiased'), look.antialiased ? 1 : 0);
    gl.uniform1f(at('growth'), growth);
    for (const [i, name] of ['low', 'high'].entries()) gl.uniform3fv(at(name), look.crop?.[i] ?? EVERYWHERE[i]);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    gl.bindVertexArray(this.array);
    gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, this.drawn);
  }

  #makeTarget(width, height) {
    const { gl } = this;
    if (this.canvas.width !== width || this.canvas.height !== height) {
      this.canvas.width = width;
      this.canvas.height = height;
    }
    if (this.target?.width === width && this.target?.height === height) return;
    if (this.target) {
      gl.deleteTexture(this.target.texture);
      gl.deleteFramebuffer(this.target.frame);
    }
    const texture = makeTexture(gl, this.half ? gl.RGBA16F : gl.RGBA8, width, height);
    const frame = gl.createFramebuffer();
    gl.bindFramebuffer(gl.FRAMEBUFFER, frame);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, texture, 0);
    this.target = { texture, frame, width, height };
    if (gl.checkFramebufferStatus(gl.FRAMEBUFFER) !== gl.FRAMEBUFFER_COMPLETE && this.half) {
      this.half = false;
      this.target.width = 0;
      this.#makeTarget(width, height);
    }
  }
}

function makeProgram(gl, vertex, fragment) {
  const program = gl.createProgram();
  for (const [kind, text] of [
    [gl.VERTEX_SHADER, vertex],
    [gl.FRAGMENT_SHADER, fragment],
  ]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, text);
    gl.compileShader(shader);
    gl.attachShader(program, shader);
    if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS) && !gl.isContextLost()) {
      throw new Error(`A shader does not compile: ${gl.getShaderInfoLog(shader)}`);
    }
  }
  gl.linkProgram(program);
  const places = new Map();
  const at = (name) => {
    if (!places.has(name)) places.set(name, gl.getUniformLocation(program, name));
    return places.get(name);
  };
  return { program, at };
}

function makeTexture(gl, format, width, height) {
  const texture = gl.createTexture();
  gl.bindTexture(gl.TEXTURE_2D, texture);
  gl.texStorage2D(gl.TEXTURE_2D, 1, format, width, height);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.NEAREST);
  return texture;
}

function bind(gl, unit, texture, place) {
  gl.activeTexture(gl.TEXTURE0 + unit);
  gl.bindTexture(gl.TEXTURE_2D, texture);
  gl.uniform1i(place, unit);
}

/** Write texels from place `first` on, in lines of `width`: the end of a line, whole lines, the start of a line. */
function upload(gl, texture, words, first, width) {
  gl.activeTexture(gl.TEXTURE0);
  gl.bindTexture(gl.TEXTURE_2D, texture);
  const count = words.length / 4;
  for (let done = 0; done < count; ) {
    const [x, y] = [(first + done) % width, Math.floor((first + done) / width)];
    const lines = x === 0 ? Math.floor((count - done) / width) : 0;
    const [w, h] = lines ? [width, lines] : [Math.min(width - x, count - done), 1];
    gl.texSubImage2D(gl.TEXTURE_2D, 0, x, y, w, h, gl.RGBA_INTEGER, gl.UNSIGNED_INT, words, done * 4);
    done += w * h;
  }
}
