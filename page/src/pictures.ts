/** The pictures of a photo: from a script beside the page, asked for when needed, or from within the page. */
import type { Depth } from "./measure";
import type { Photo, Pictures, Vector } from "./types";

export interface Images {
  sphere: ImageBitmap;
  scan: ImageBitmap | null;
  mask: ImageBitmap | null;
  alternatives: (ImageBitmap | null)[];
  depth: Depth | null;
  /** Directions of the camera's frame in which the photo shows something. */
  lit: Vector[];
}

const KEPT = 4; // photos whose pictures stay in memory
const DEPTH_FROM = 0.05; // m, as in piccolo/report/pictures.py
const DEPTH_STEP = 0.001;
const COARSE = 96; // px, the width at which it is asked where a photo is black
const DARK = 24; // of 3 * 255, as JPEG writes black
const kept = new Map<string, Promise<Images>>();

/** The pictures of a photo, drawn; at most `most` px wide, as the graphics allow. */
export function imagesOf(photo: Photo, most: number): Promise<Images> {
  const found = kept.get(photo.key);
  const images = found ?? decoded(photo.key, most);
  kept.delete(photo.key);
  kept.set(photo.key, images);
  if (!found) images.catch(() => kept.delete(photo.key));
  for (const [key, old] of kept) {
    if (kept.size <= KEPT) break;
    kept.delete(key);
    old.then(release, () => undefined);
  }
  return images;
}

function release(images: Images): void {
  for (const image of [images.sphere, images.scan, images.mask, ...images.alternatives]) image?.close();
}

async function decoded(key: string, most: number): Promise<Images> {
  const pictures = await load(key);
  const picture = (data?: string | null, type = "image/jpeg") => (data ? bitmap(data, type, most) : Promise.resolve(null));
  const [depth, sphere, scan, mask, ...alternatives] = await Promise.all([
    pictures.depth ? unpackDepth(pictures.depth).catch(() => null) : null, // a browser from before 2023 can't
    bitmap(pictures.sphere, "image/jpeg", most),
    picture(pictures.scan),
    picture(pictures.mask, "image/png"),
    ...(pictures.alternatives ?? []).map((data) => picture(data)),
  ]);
  return { sphere, scan, mask, alternatives, depth, lit: litOf(sphere) };
}

/** The directions of a sphere's pixels that are not black, coarsely. */
function litOf(sphere: ImageBitmap): Vector[] {
  const [width, height] = [COARSE, COARSE / 2];
  const context = new OffscreenCanvas(width, height).getContext("2d")!;
  context.drawImage(sphere, 0, 0, width, height);
  const { data } = context.getImageData(0, 0, width, height);
  const pixels = Array.from({ length: width * height }, (_, k) => k);
  const isLit = (k: number) => data[4 * k] + data[4 * k + 1] + data[4 * k + 2] > DARK;
  return pixels.filter(isLit).map((k) => {
    const azimuth = (0.5 - ((k % width) + 0.5) / width) * 2 * Math.PI;
    const elevation = (0.5 - (Math.floor(k / width) + 0.5) / height) * Math.PI;
    const level = Math.cos(elevation);
    return [level * Math.cos(azimuth), level * Math.sin(azimuth), Math.sin(elevation)];
  });
}

function bytesOf(data: string): Uint8Array<ArrayBuffer> {
  return Uint8Array.from(atob(data), (letter) => letter.charCodeAt(0));
}

/** Ranges from the differences of their codes, as `pack_depth` writes them: no picture, which a browser may alter. */
export async function unpackDepth(data: string): Promise<Depth> {
  const stream = new Blob([bytesOf(data)]).stream().pipeThrough(new DecompressionStream("deflate"));
  const bytes = new Uint8Array(await new Response(stream).arrayBuffer());
  const count = bytes.length / 2;
  const width = Math.sqrt(2 * count);
  const codes = new Int32Array(width + 1 + count); // zeros above the first row, and before it
  const ranges = new Float32Array(count);
  for (let k = 0, at = width + 1; k < count; k++, at++) {
    const folded = 256 * bytes[k] + bytes[count + k];
    const isFirst = k % width === 0;
    const before = isFirst ? 0 : codes[at - 1] - codes[at - width - 1];
    codes[at] = (folded % 2 ? -(folded + 1) / 2 : folded / 2) + codes[at - width] + before;
    ranges[k] = codes[at] && DEPTH_FROM * Math.exp((codes[at] - 1) * DEPTH_STEP);
  }
  return { width, ranges };
}

async function bitmap(data: string, type: string, most: number): Promise<ImageBitmap> {
  const blob = new Blob([bytesOf(data)], { type });
  const whole = await createImageBitmap(blob);
  if (whole.width <= most) return whole;
  whole.close();
  return createImageBitmap(blob, { resizeWidth: most, resizeHeight: most / 2, resizeQuality: "high" });
}

function load(key: string): Promise<Pictures> {
  const within = document.getElementById(`photo-${key}`);
  if (within) return Promise.resolve(JSON.parse(within.textContent!) as Pictures);
  const dropped = window.PICCOLO_PHOTOS?.[key]; // and may still be on its way
  if (dropped) return Promise.resolve(dropped);
  return new Promise((resolve, reject) => {
    const script = document.createElement("script");
    script.src = `photos/${key}.js`;
    script.addEventListener("load", () => {
      const pictures = window.PICCOLO_PHOTOS?.[key];
      delete window.PICCOLO_PHOTOS?.[key]; // its text is large
      script.remove();
      if (pictures) resolve(pictures);
      else reject(new Error(script.src));
    });
    script.addEventListener("error", () => {
      script.remove();
      reject(new Error(script.src));
    });
    document.head.append(script);
  });
}
