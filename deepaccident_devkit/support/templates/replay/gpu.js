// WebGL 2: points, thick lines, triangles and one picture on the ground; each kind has a shader and a buffer.
//
// Written here because the packages that PyPI has do not fit: standalone.js of k3d 3.2 (2.6 MB) and plotly.min.js of
// plotly 7.1 (4.8 MB) add style elements, which the page's policy refuses, compile code from text, which would need
// `unsafe-eval`, and would be a new dependency.

const SHARED = "#version 300 es\nprecision highp float;\nuniform mat4 view;\nuniform vec2 size;\n";
/** @typedef {"points" | "lines" | "faces" | "picture"} Kind */
/** @typedef {{ buffer: WebGLBuffer, room: number, array: WebGLVertexArrayObject, count: number }} KindBuffer */

/** @type {Record<Kind, { vertex: string, fragment: string }>} */
const SHADERS = {
  points: {
    vertex: `in vec3 position; in vec4 color; out vec4 tint; uniform float near;
      void main() { gl_Position = view * vec4(position, 1.0); tint = color;
        gl_PointSize = clamp(near / gl_Position.w, 1.3, 3.2) * size.y; }`,
    fragment: "in vec4 tint; out vec4 shown; void main() { shown = vec4(tint.rgb * tint.a, tint.a); }",
  },
  // a line is four corners; what lies behind the eye is cut off
  lines: {
    vertex: `in vec2 corner; in vec3 from; in vec3 to; in vec4 color; in float width; out vec4 tint;
      uniform vec2 pixels;
      void main() {
        vec4 a = view * vec4(from, 1.0), b = view * vec4(to, 1.0);
        float minDepth = 0.3;
        if (a.w < minDepth && b.w < minDepth) { gl_Position = vec4(2.0, 2.0, 2.0, 1.0); return; }
        if (a.w < minDepth) a = mix(a, b, (minDepth - a.w) / (b.w - a.w));
        if (b.w < minDepth) b = mix(b, a, (minDepth - b.w) / (a.w - b.w));
        vec2 along = (b.xy / b.w - a.xy / a.w) * pixels;
        vec2 beside = length(along) > 0.0 ? normalize(vec2(-along.y, along.x)) : vec2(0.0);
        vec4 end = corner.x < 0.5 ? a : b;
        gl_Position = vec4(end.xy + beside * corner.y * width * size.y / pixels * end.w, end.zw);
        tint = color;
      }`,
    fragment: "in vec4 tint; out vec4 shown; void main() { shown = vec4(tint.rgb * tint.a, tint.a); }",
  },
  faces: {
    vertex: `in vec3 position; in vec4 color; out vec4 tint;
      void main() { gl_Position = view * vec4(position, 1.0); tint = color; }`,
    fragment: "in vec4 tint; out vec4 shown; void main() { shown = vec4(tint.rgb * tint.a, tint.a); }",
  },
  picture: {
    vertex: `in vec3 position; in vec2 at; out vec2 spot;
      void main() { gl_Position = view * vec4(position, 1.0); spot = at; }`,
    fragment: `in vec2 spot; out vec4 shown; uniform sampler2D image; uniform float shade;
      void main() {
        vec4 seen = texture(image, spot);
        if (seen.a < 0.5) discard;
        shown = vec4(seen.rgb * shade, 1.0);
      }`,
  },
};
/** @type {Record<Kind, Record<string, number>>} attributes, and how many numbers each has */
const LAYOUTS = {
  points: { position: 3, color: 4 },
  lines: { from: 3, to: 3, color: 4, width: 1 },
  faces: { position: 3, color: 4 },
  picture: { position: 3, at: 2 },
};
const CORNERS = new Float32Array([0, -1, 0, 1, 1, -1, 1, 1]);

/** @type {Kind[]} */
const KINDS = ["points", "lines", "faces", "picture"];

/**
 * What a graphics processor holds for one canvas: as much after an hour as at the beginning.
 */
export class Gpu {
  /** @param {WebGL2RenderingContext} gl */
  constructor(gl) {
    this.gl = gl;
    this.view = new Float32Array(16);
    /** @type {[width: number, height: number]} */
    this.pixels = [1, 1];
    this.ratio = 1;
    this.corners = gl.createBuffer(); // those of a line
    /** @type {Record<Kind, WebGLProgram>} */
    this.programs = {
      points: this.program(SHADERS.points),
      lines: this.program(SHADERS.lines),
      faces: this.program(SHADERS.faces),
      picture: this.program(SHADERS.picture),
    };
    /** @type {Record<Kind, KindBuffer>} */
    this.buffers = { points: this.buffer(), lines: this.buffer(), faces: this.buffer(), picture: this.buffer() };
    for (const kind of KINDS) this.describe(kind);
    /** @type {WebGLTexture | null} */
    this.texture = null;
  }

  /** @returns {KindBuffer} */
  buffer() {
    return { buffer: this.gl.createBuffer(), room: 0, array: this.gl.createVertexArray(), count: 0 };
  }

  /** @param {{ vertex: string, fragment: string }} texts */
  program({ vertex, fragment }) {
    const gl = this.gl;
    const program = gl.createProgram();
    this.attach(program, gl.VERTEX_SHADER, SHARED + vertex);
    this.attach(program, gl.FRAGMENT_SHADER, SHARED + fragment);
    gl.linkProgram(program);
    return program;
  }

  /**
   * @param {WebGLProgram} program
   * @param {number} type
   * @param {string} text
   */
  attach(program, type, text) {
    const gl = this.gl;
    const shader = gl.createShader(type);
    if (shader === null) return; // the context is lost
    gl.shaderSource(shader, text);
    gl.compileShader(shader);
    gl.attachShader(program, shader);
    gl.deleteShader(shader); // it goes with its program
  }

  /**
   * Say where a kind's attributes lie in its buffer. Each line has the corners again.
   * @param {Kind} kind
   */
  describe(kind) {
    const gl = this.gl;
    const { buffer, array } = this.buffers[kind];
    gl.bindVertexArray(array);
    if (kind === "lines") {
      gl.bindBuffer(gl.ARRAY_BUFFER, this.corners);
      gl.bufferData(gl.ARRAY_BUFFER, CORNERS, gl.STATIC_DRAW);
      this.attribute(kind, "corner", { count: 2, stride: 8, offset: 0, divisor: 0 });
    }
    gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
    const stride = 4 * numbersOf(kind);
    let offset = 0;
    for (const [name, count] of Object.entries(LAYOUTS[kind])) {
      this.attribute(kind, name, { count, stride, offset, divisor: kind === "lines" ? 1 : 0 });
      offset += 4 * count;
    }
    gl.bindVertexArray(null);
  }

  /**
   * @param {Kind} kind
   * @param {string} name
   * @param {{ count: number, stride: number, offset: number, divisor: number }} layout
   */
  attribute(kind, name, { count, stride, offset, divisor }) {
    const gl = this.gl;
    const location = gl.getAttribLocation(this.programs[kind], name);
    gl.enableVertexAttribArray(location);
    gl.vertexAttribPointer(location, count, gl.FLOAT, false, stride, offset);
    gl.vertexAttribDivisor(location, divisor);
  }

  /**
   * Give a kind new numbers, in the memory that it has if they fit.
   * @param {Kind} kind
   * @param {Numbers} numbers
   */
  fill(kind, { array, count }) {
    const gl = this.gl;
    const own = this.buffers[kind];
    gl.bindBuffer(gl.ARRAY_BUFFER, own.buffer);
    if (count > own.room) {
      own.room = count;
      gl.bufferData(gl.ARRAY_BUFFER, array.subarray(0, count), gl.DYNAMIC_DRAW);
    } else gl.bufferSubData(gl.ARRAY_BUFFER, 0, array.subarray(0, count));
    own.count = count / numbersOf(kind);
  }

  /** @param {HTMLImageElement} image the picture on the ground */
  paint(image) {
    const gl = this.gl;
    if (!this.texture) this.texture = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D, this.texture);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, gl.RGBA, gl.UNSIGNED_BYTE, image);
    gl.generateMipmap(gl.TEXTURE_2D);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.LINEAR_MIPMAP_LINEAR);
    for (const side of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.texParameteri(gl.TEXTURE_2D, side, gl.CLAMP_TO_EDGE);
  }

  /**
   * Begin a picture.
   * @param {Float32Array<ArrayBuffer>} view the matrix from the world to the picture
   * @param {[width: number, height: number]} pixels of the screen
   * @param {number} ratio the screen's pixels by the page's
   */
  begin(view, pixels, ratio) {
    const gl = this.gl;
    this.view = view;
    this.pixels = pixels;
    this.ratio = ratio;
    gl.viewport(0, 0, ...pixels);
    gl.clearColor(0, 0, 0, 0);
    gl.depthMask(true);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.enable(gl.DEPTH_TEST);
    gl.depthFunc(gl.LEQUAL);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
  }

  /**
   * Draw all of a kind.
   * @param {Kind} kind
   * @param {Record<string, number>} uniforms
   */
  draw(kind, uniforms = {}) {
    const gl = this.gl;
    const { array, count } = this.buffers[kind];
    if (!count || (kind === "picture" && !this.texture)) return;
    const program = this.programs[kind];
    gl.useProgram(program);
    gl.uniformMatrix4fv(gl.getUniformLocation(program, "view"), false, this.view);
    gl.uniform2f(gl.getUniformLocation(program, "size"), 1, this.ratio);
    if (kind === "lines") gl.uniform2f(gl.getUniformLocation(program, "pixels"), ...this.pixels);
    for (const [name, value] of Object.entries(uniforms)) gl.uniform1f(gl.getUniformLocation(program, name), value);
    gl.depthMask(kind !== "faces"); // what is behind a glass face is seen
    gl.bindVertexArray(array);
    if (kind === "lines") gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, count);
    else gl.drawArrays(kind === "points" ? gl.POINTS : gl.TRIANGLES, 0, count);
    gl.bindVertexArray(null);
  }

  /** Give all memory back. */
  free() {
    const gl = this.gl;
    for (const { buffer, array } of Object.values(this.buffers)) {
      gl.deleteBuffer(buffer);
      gl.deleteVertexArray(array);
    }
    gl.deleteBuffer(this.corners);
    for (const program of Object.values(this.programs)) gl.deleteProgram(program);
    if (this.texture) gl.deleteTexture(this.texture);
  }
}

/**
 * Return how many numbers one thing of a kind has.
 * @param {Kind} kind
 */
function numbersOf(kind) {
  return Object.values(LAYOUTS[kind]).reduce((sum, count) => sum + count, 0);
}

/** Numbers that are added one after the other; the array grows and is used again. */
export class Numbers {
  constructor() {
    this.array = new Float32Array(1 << 12);
    this.count = 0;
  }

  /** @param {number[]} values */
  add(...values) {
    this.addAll(values);
  }

  /** @param {ArrayLike<number>} values */
  addAll(values) {
    const count = this.count + values.length;
    if (count > this.array.length) {
      const larger = new Float32Array(Math.max(count, 2 * this.array.length));
      larger.set(this.array);
      this.array = larger;
    }
    this.array.set(values, this.count);
    this.count = count;
  }
}
