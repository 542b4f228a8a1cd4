/** A photo and the scan as spheres, one over the other, drawn by three.js in one pass over the screen. */
import {
  Camera,
  LinearFilter,
  LinearSRGBColorSpace,
  Matrix3,
  Mesh,
  NoColorSpace,
  PlaneGeometry,
  RepeatWrapping,
  Scene,
  ShaderMaterial,
  Texture,
  Vector2,
  WebGLRenderer,
} from "three";
import type { Mode, View } from "./model";
import type { Vector } from "./types";

export const LEAST_FOV = 0.25;
export const MOST_FOV = 2.0;
const MOST_PITCH = Math.PI / 2 - 0.01;

const VERTEX = `
varying vec2 screen;
void main() {
  screen = position.xy;
  gl_Position = vec4(position.xy, 0.0, 1.0);
}`;

// A ray of the screen in the plan's frame, turned into each camera's, gives the pixel of its sphere:
// u = (1/2 - azimuth / 2 pi) W, v = (1/2 - elevation / pi) H.
const FRAGMENT = `
precision highp float;
varying vec2 screen;
uniform sampler2D photo, scan, mask, before;
uniform mat3 photoFromPlan, scanFromPlan, beforeFromPlan;
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
  vec2 at = pixelOf(photoFromPlan * ray);
  vec3 color = texture2D(photo, at).rgb;
  float ofScan = splitAt >= -1.5 ? step(splitAt, screen.x) : mixing;
  if (ofScan > 0.0) color = mix(color, texture2D(scan, pixelOf(scanFromPlan * ray)).rgb, ofScan);
  if (hatching > 0.0) {
    float level = smoothstep(0.62, 0.82, texture2D(mask, at).r);
    float line = step(0.5, fract((gl_FragCoord.x + gl_FragCoord.y) / 12.0));
    color = mix(color, vec3(1.0, 0.16, 0.45), level * mix(0.3, 0.62, line));
  }
  if (fading > 0.0) color = mix(color, texture2D(before, pixelOf(beforeFromPlan * ray)).rgb, fading);
  gl_FragColor = vec4(color, 1.0);
}`;

/** What is on the spheres. */
export interface Content {
  photo: ImageBitmap;
  scan: ImageBitmap | null;
  mask: ImageBitmap | null;
  /** R_cam_from_plan of photo and scan, row by row. */
  rotation: number[];
}

export class Sphere {
  readonly mostWidth: number;
  private readonly renderer: WebGLRenderer;
  private readonly scene = new Scene();
  private readonly camera = new Camera();
  private readonly uniforms = {
    photo: { value: new Texture() },
    scan: { value: new Texture() },
    mask: { value: new Texture() },
    before: { value: new Texture() },
    photoFromPlan: { value: new Matrix3() },
    scanFromPlan: { value: new Matrix3() },
    beforeFromPlan: { value: new Matrix3() },
    tangents: { value: new Vector2(1, 1) },
    looks: { value: new Vector2() },
    mixing: { value: 0 },
    splitAt: { value: -2 },
    fading: { value: 0 },
    hatching: { value: 0 },
  };
  private frame = 0;
  private fadeFrom = 0;
  private hasContent = false;
  private view: View = { yaw: 0, pitch: 0, fov: 1.2 };
  private readonly isStill = matchMedia("(prefers-reduced-motion: reduce)");

  /** Throws where there is no WebGL. */
  constructor(readonly canvas: HTMLCanvasElement) {
    this.renderer = new WebGLRenderer({ canvas, antialias: false, powerPreference: "low-power" });
    this.renderer.outputColorSpace = LinearSRGBColorSpace;
    this.mostWidth = this.renderer.capabilities.maxTextureSize;
    const material = new ShaderMaterial({
      vertexShader: VERTEX,
      fragmentShader: FRAGMENT,
      uniforms: this.uniforms,
      depthTest: false,
    });
    const screen = new Mesh(new PlaneGeometry(2, 2), material);
    screen.frustumCulled = false;
    this.scene.add(screen);
    new ResizeObserver(() => this.resized()).observe(canvas);
  }

  private resized(): void {
    const { clientWidth, clientHeight } = this.canvas;
    if (!clientWidth || !clientHeight) return;
    this.renderer.setPixelRatio(Math.min(window.devicePixelRatio || 1, 2));
    this.renderer.setSize(clientWidth, clientHeight, false);
    this.look(this.view);
    this.paint(performance.now());
  }

  /** Put a photo on the sphere; the one before fades out if `fades`. */
  show(content: Content, fades: boolean): void {
    const u = this.uniforms;
    const isNewPhoto = u.photo.value.image !== content.photo;
    if (fades && this.hasContent && isNewPhoto && !this.isStill.matches) {
      const unused = u.before.value;
      u.before.value = u.photo.value;
      u.beforeFromPlan.value.copy(u.photoFromPlan.value);
      u.photo.value = unused;
      this.fadeFrom = performance.now();
      u.fading.value = 1;
    }
    u.photo.value = replaced(u.photo.value, content.photo);
    u.scan.value = replaced(u.scan.value, content.scan);
    u.mask.value = replaced(u.mask.value, content.mask);
    u.photoFromPlan.value.fromArray(content.rotation).transpose();
    u.scanFromPlan.value.fromArray(content.rotation).transpose();
    this.hasContent = true;
    this.draw();
  }

  /** How photo and scan are put together: blend by `amount`, or side by side there. */
  combine(mode: Mode, amount: number, showsDifferences: boolean): void {
    const u = this.uniforms;
    const hasScan = u.scan.value.image !== null;
    u.mixing.value = !hasScan || mode === "photo" ? 0 : mode === "scan" ? 1 : amount;
    u.splitAt.value = hasScan && mode === "split" ? 2 * amount - 1 : -2;
    u.hatching.value = showsDifferences && u.mask.value.image !== null ? 1 : 0;
    this.draw();
  }

  look(view: View): void {
    view.pitch = Math.max(-MOST_PITCH, Math.min(MOST_PITCH, view.pitch));
    view.fov = Math.max(LEAST_FOV, Math.min(MOST_FOV, view.fov));
    this.view = view;
    const { clientWidth: width, clientHeight: height } = this.canvas;
    const tangent = Math.tan(view.fov / 2);
    this.uniforms.tangents.value.set((tangent * width) / Math.max(1, height), tangent);
    this.uniforms.looks.value.set(view.yaw, view.pitch);
    this.draw();
  }

  draw(): void {
    this.frame ||= requestAnimationFrame((now) => {
      this.frame = 0;
      this.paint(now);
    });
  }

  private paint(now: number): void {
    if (!this.hasContent) return;
    const { fading } = this.uniforms;
    if (fading.value > 0) {
      const part = Math.max(0, Math.min(1, (now - this.fadeFrom) / 320));
      fading.value = 1 - part * part * (3 - 2 * part);
      if (fading.value > 0) this.draw();
    }
    this.renderer.render(this.scene, this.camera);
  }

  /** Where a direction of the plan's frame lies on the canvas [px]; null if it is behind. */
  project([x, y, z]: Vector): { x: number; y: number } | null {
    const { yaw, pitch } = this.view;
    const ahead = Math.cos(yaw) * x + Math.sin(yaw) * y;
    const left = Math.cos(yaw) * y - Math.sin(yaw) * x;
    const depth = Math.cos(pitch) * ahead + Math.sin(pitch) * z;
    const up = Math.cos(pitch) * z - Math.sin(pitch) * ahead;
    if (depth < 0.05) return null;
    const { x: tx, y: ty } = this.uniforms.tangents.value;
    const { clientWidth: width, clientHeight: height } = this.canvas;
    return { x: (width / 2) * (1 - left / depth / tx), y: (height / 2) * (1 - up / depth / ty) };
  }

  /** Angle [rad] of a pixel in the middle of the canvas. */
  get pixelAngle(): number {
    return (2 * this.uniforms.tangents.value.y) / Math.max(1, this.canvas.clientHeight);
  }
}

/** A texture of another picture; the one before is given back. */
function replaced(texture: Texture, image: ImageBitmap | null): Texture {
  if (texture.image === image && image !== null) return texture;
  texture.dispose();
  const made = new Texture(image ?? undefined);
  made.image = image as never;
  made.colorSpace = NoColorSpace;
  made.flipY = false;
  made.generateMipmaps = false;
  made.minFilter = made.magFilter = LinearFilter;
  made.wrapS = RepeatWrapping;
  made.needsUpdate = image !== null;
  return made;
}
