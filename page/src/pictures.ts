/** The pictures of a photo: from a script beside the page, asked for when needed, or from within the page. */
import type { Photo, Pictures } from "./types";

export interface Images {
  sphere: ImageBitmap;
  scan: ImageBitmap | null;
  mask: ImageBitmap | null;
  alternatives: (ImageBitmap | null)[];
  reach: Uint8Array | null;
}

const KEPT = 4; // photos whose pictures stay in memory
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
  const [sphere, scan, mask, ...alternatives] = await Promise.all([
    bitmap(pictures.sphere, "image/jpeg", most),
    picture(pictures.scan),
    picture(pictures.mask, "image/png"),
    ...(pictures.alternatives ?? []).map((data) => picture(data)),
  ]);
  return { sphere, scan, mask, alternatives, reach: pictures.reach ? bytesOf(pictures.reach) : null };
}

function bytesOf(data: string): Uint8Array<ArrayBuffer> {
  return Uint8Array.from(atob(data), (letter) => letter.charCodeAt(0));
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
