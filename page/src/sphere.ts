/** A photo and the scan as spheres, one over the other, drawn by WebGL as one triangle over the whole screen. */
import type { Mode, View } from "./model";
import type { Vector } from "./types";

export const LEAST_FOV = 0.25;
export const MOST_FOV = 2.0;
const MOST_PITCH = Math.PI / 2 - 0.01;
const FADE = 320; // ms

const VERTEX = `#version 300 es
out vec2 screen;
void main() {
  screen = vec2(gl_VertexID == 1 ? 3.0 : -1.0, gl_VertexID == 2 ? 3.0 : -1.0);
  gl_Position = vec4(screen, 0.0, 1.0);
}`;

// A ray of the screen in the plan's frame, turned into each camera's, gives the pixel of its sphere:
// u = (1/2 - azimuth / 2 pi) W, v = (1/2 - elevation / pi) H.
const FRAGMENT = `#version 300 es
precision highp float;
in vec2 screen;
out vec4 shown;
uniform sampler2D photo, scan, mask, before;
uniform mat3 camFromPlan, beforeFromPlan;
uniform vec2 tangents;
uniform vec2 looks;
uniform float mixing, splitAt, fading, hatching;

vec2 pixelOf(vec3 ray) {
  const float PI = 3.14159265358979;
  float elevation = atan(ray.z, length(ray.xy));
  return vec2(0.5 - atan(ray.y, ray.x) / (2.0 * PI), 0.5 - elevation / PI);
}

void main() {
  vec3 ray = normalize(vec3(1.0, -screen.x * tangents.x, screen.y * tangents.y));
  float c = cos(looks.y), s = sin(looks.y);
  ray = vec3(c * ray.x - s * ray.z, ray.y, s * ray.x + c * ray.z);
  c = cos(looks.x), s = sin(looks.x);
  ray = vec3(c * ray.x - s * ray.y, s * ray.x + c * ray.y, ray.z);
  vec2 at = pixelOf(camFromPlan * ray);
  vec3 color = texture(photo, at).rgb;
  float ofScan = splitAt >= -1.5 ? step(splitAt, screen.x) : mixing;
  if (ofScan > 0.0) color = mix(color, texture(scan, at).rgb, ofScan);
  if (hatching > 0.0) {
    float level = smoothstep(0.62, 0.82, texture(mask, at).r);
    float line = step(0.5, fract((gl_FragCoord.x + gl_FragCoord.y) / 12.0));
    color = mix(color, vec3(1.0, 0.16, 0.45), level * mix(0.3, 0.62, line));
  }
  if (fading > 0.0) color = mix(color, texture(before, pixelOf(beforeFromPlan * ray)).rgb, fading);
  shown = vec4(color, 1.0);
}`;

/** What is on the spheres. */
export interface Content {
  photo: ImageBitmap;
  scan: ImageBitmap | null;
  mask: ImageBitmap | null;
  /** R_cam_from_plan of photo and scan, row by row. */
  rotation: number[];
}

const LAYERS = ["photo", "scan", "mask", "before"] as const;
const EYE = [1, 0, 0, 0, 1, 0, 0, 0, 1];

export class Sphere {
  readonly mostWidth: number;
  private readonly gl: WebGL2RenderingContext;
  private program!: WebGLProgram;
  /** The pictures that the graphics hold, in the order of LAYERS. */
  private textures: WebGLTexture[] = [];
  private content: Content | null = null;
  private rotationBefore = EYE;
  private readonly numbers = { mixing: 0, splitAt: -2, fading: 0, hatching: 0 };
  private tangents: [number, number] = [1, 1];
  private frame = 0;
  private fadeFrom = 0;
  private view: View = { yaw: 0, pitch: 0, fov: 1.2 };
  private readonly isStill = matchMedia("(prefers-reduced-motion: reduce)");

  /** Throws where there is no WebGL. */
  constructor(readonly canvas: HTMLCanvasElement) {
    const gl = canvas.getContext("webgl2", { alpha: false, antialias: false, depth: false, powerPreference: "low-power" });
    if (!gl) throw new Error("no WebGL");
    this.gl = gl;
    this.mostWidth = gl.getParameter(gl.MAX_TEXTURE_SIZE) as number;
    this.begin();
    canvas.addEventListener("webglcontextlost", (event) => event.preventDefault());
    canvas.addEventListener("webglcontextrestored", () => this.begin());
    new ResizeObserver(() => this.resized()).observe(canvas);
  }

  /** Hand the graphics what they work with, again where they have lost it. */
  private begin(): void {
    const { gl } = this;
    this.program = gl.createProgram();
    for (const [type, source] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, FRAGMENT]] as const) {
      const shader = gl.createShader(type)!;
      gl.shaderSource(shader, source);
      gl.compileShader(shader);
      gl.attachShader(this.program, shader);
    }
    gl.linkProgram(this.program);
    if (!gl.getProgramParameter(this.program, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(this.program) ?? "WebGL");
    gl.useProgram(this.program);
    LAYERS.forEach((name, unit) => gl.uniform1i(this.at(name), unit));
    this.textures = LAYERS.map(() => gl.createTexture());
    LAYERS.forEach((_, unit) => this.fill(unit, null));
    const { content } = this;
    this.content = null;
    this.numbers.fading = 0;
    if (content) this.show(content, false);
  }

  private at(name: string): WebGLUniformLocation | null {
    return this.gl.getUniformLocation(this.program, name);
  }

  private resized(): void {
    const { canvas } = this;
    if (!canvas.clientWidth || !canvas.clientHeight) return;
    const ratio = Math.min(window.devicePixelRatio || 1, 2);
    canvas.width = Math.floor(canvas.clientWidth * ratio);
    canvas.height = Math.floor(canvas.clientHeight * ratio);
    this.look(this.view);
    this.paint(performance.now());
  }

  /** Put a photo on the sphere; the one before fades out if `fades`. */
  show(content: Content, fades: boolean): void {
    const old = this.content;
    if (fades && old && old.photo !== content.photo && !this.isStill.matches) {
      [this.textures[0], this.textures[3]] = [this.textures[3], this.textures[0]];
      this.rotationBefore = old.rotation;
      this.fadeFrom = performance.now();
      this.numbers.fading = 1;
    }
    for (const [unit, name] of (["photo", "scan", "mask"] as const).entries()) {
      if (old?.[name] !== content[name]) this.fill(unit, content[name]);
    }
    this.content = content;
    this.draw();
  }

  /** Put a picture into a texture; a black pixel for none. */
  private fill(unit: number, image: ImageBitmap | null): void {
    const { gl } = this;
    gl.bindTexture(gl.TEXTURE_2D, this.textures[unit]);
    if (image) gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, gl.RGBA, gl.UNSIGNED_BYTE, image);
    else gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, 1, 1, 0, gl.RGBA, gl.UNSIGNED_BYTE, null);
    for (const name of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, name, gl.LINEAR);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_S, gl.REPEAT);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_T, gl.CLAMP_TO_EDGE);
  }

  /** How photo and scan are put together: blend by `amount`, or side by side there. */
  combine(mode: Mode, amount: number, showsDifferences: boolean): void {
    const hasScan = Boolean(this.content?.scan);
    this.numbers.mixing = !hasScan || mode === "photo" ? 0 : mode === "scan" ? 1 : amount;
    this.numbers.splitAt = hasScan && mode === "split" ? 2 * amount - 1 : -2;
    this.numbers.hatching = showsDifferences && this.content?.mask ? 1 : 0;
    this.draw();
  }

  look(view: View): void {
    view.pitch = Math.max(-MOST_PITCH, Math.min(MOST_PITCH, view.pitch));
    view.fov = Math.max(LEAST_FOV, Math.min(MOST_FOV, view.fov));
    this.view = view;
    const { clientWidth: width, clientHeight: height } = this.canvas;
    const tangent = Math.tan(view.fov / 2);
    this.tangents = [(tangent * width) / Math.max(1, height), tangent];
    this.draw();
  }

  draw(): void {
    this.frame ||= requestAnimationFrame((now) => {
      this.frame = 0;
      this.paint(now);
    });
  }

  private paint(now: number): void {
    const { gl, content, numbers } = this;
    if (!content) return;
    if (numbers.fading > 0) {
      const part = Math.max(0, Math.min(1, (now - this.fadeFrom) / FADE));
      numbers.fading = 1 - part * part * (3 - 2 * part);
      if (numbers.fading > 0) this.draw();
    }
    this.textures.forEach((texture, unit) => {
      gl.activeTexture(gl.TEXTURE0 + unit);
      gl.bindTexture(gl.TEXTURE_2D, texture);
    });
    gl.uniformMatrix3fv(this.at("camFromPlan"), true, content.rotation);
    gl.uniformMatrix3fv(this.at("beforeFromPlan"), true, this.rotationBefore);
    gl.uniform2fv(this.at("tangents"), this.tangents);
    gl.uniform2f(this.at("looks"), this.view.yaw, this.view.pitch);
    for (const [name, value] of Object.entries(numbers)) gl.uniform1f(this.at(name), value);
    gl.viewport(0, 0, this.canvas.width, this.canvas.height);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }

  /** Where a direction of the plan's frame lies on the canvas [px]; null if it is behind. */
  project([x, y, z]: Vector): { x: number; y: number } | null {
    const { yaw, pitch } = this.view;
    const ahead = Math.cos(yaw) * x + Math.sin(yaw) * y;
    const left = Math.cos(yaw) * y - Math.sin(yaw) * x;
    const depth = Math.cos(pitch) * ahead + Math.sin(pitch) * z;
    const up = Math.cos(pitch) * z - Math.sin(pitch) * ahead;
    if (depth < 0.05) return null;
    const [tx, ty] = this.tangents;
    const { clientWidth: width, clientHeight: height } = this.canvas;
    return { x: (width / 2) * (1 - left / depth / tx), y: (height / 2) * (1 - up / depth / ty) };
  }

  /** The direction of the plan's frame, unit, that a place on the canvas [px] shows. */
  rayAt(x: number, y: number): Vector {
    const { yaw, pitch } = this.view;
    const { clientWidth: width, clientHeight: height } = this.canvas;
    const left = (1 - (2 * x) / width) * this.tangents[0];
    const up = (1 - (2 * y) / height) * this.tangents[1];
    const ahead = Math.cos(pitch) - Math.sin(pitch) * up;
    const ray = [Math.cos(yaw) * ahead - Math.sin(yaw) * left, Math.sin(yaw) * ahead + Math.cos(yaw) * left, Math.sin(pitch) + Math.cos(pitch) * up];
    return ray.map((value) => value / Math.hypot(...ray)) as Vector;
  }

  get photoWidth(): number {
    return this.content?.photo.width ?? 1;
  }

  /** Angle [rad] of a pixel in the middle of the canvas. */
  get pixelAngle(): number {
    return (2 * this.tangents[1]) / Math.max(1, this.canvas.clientHeight);
  }
}
