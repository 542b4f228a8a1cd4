/** The pictures of a photo: from a script beside the page, asked for when needed, or from within the page. */
import type { Depth } from "./measure";
import type { Photo, Pictures } from "./types";

export interface Images {
  sphere: ImageBitmap;
  scan: ImageBitmap | null;
  mask: ImageBitmap | null;
  alternatives: (ImageBitmap | null)[];
  depth: Depth | null;
}

const KEPT = 4; // photos whose pictures stay in memory
const DEPTH_FROM = 0.05; // m, as in piccolo/report/pictures.py
const DEPTH_STEP = 0.001;
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
  return { sphere, scan, mask, alternatives, depth };
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
