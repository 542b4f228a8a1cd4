/** Sends a photo to the service that served the page, and reads its answer line by line. */
import { text } from "./text";
import type { Photo, Pictures } from "./types";

export const LOST = 0; // the network, in place of a status of HTTP
export const REPLACED = 409;
export const TOO_LARGE = 413;
export const NO_PICTURE = 422;
const BUSY = 503;
const RADIUS = 5; // m around a place, unless another is told

/** What a person knows that a photo's file does not say, by the names of the dialog's fields; "" is unknown. */
export type Options = Record<string, string>;

export interface Found {
  photo: Photo;
  result: { cloud_sha256: string | null };
  /** Come a little later, or fail. */
  pictures: Promise<{ pictures: Pictures; thumb: string }>;
}

export class Refusal extends Error {
  constructor(
    readonly status: number,
    words: string,
    /** After which to ask again; null unless the service is busy. */
    readonly seconds: number | null = null,
  ) {
    super(words);
  }

  get mayPass(): boolean {
    return this.status === LOST || this.status >= 500;
  }
}

/** Localize a photo; throws a Refusal. */
export async function send(file: File, options: object, signal: AbortSignal): Promise<Found> {
  const form = new FormData();
  form.append("picture", file);
  form.append("options", JSON.stringify(options));
  try {
    const response = await fetch("show", { method: "POST", body: form, signal });
    if (!response.ok) {
      const wait = response.status === BUSY ? Number(response.headers.get("Retry-After")) || 5 : null;
      throw new Refusal(response.status, (await response.json()).error, wait);
    }
    const lines = linesOf(response.body!);
    const next = async () => JSON.parse((await lines.next()).value as string);
    const found = await next();
    const pictures = next().then((line) => (line.error ? Promise.reject(new Error(line.error)) : line));
    pictures.finally(() => lines.next()).catch(() => undefined); // to its end, or the browser counts it as broken off
    return { ...found, pictures };
  } catch (error) {
    throw error instanceof Refusal ? error : new Refusal(LOST, text.drop.lost);
  }
}

/** Options as the service reads them: those of the lens are for photos that are not spheres, and a field is known about. */
export function asJson({ fov, focal, x, y, radius }: Options, isSphere: boolean): object {
  const lens = focal ? { focal_px: Number(focal) } : { fov_deg: Number(fov), refine_focal: true };
  return {
    photo: (fov || focal) && !isSphere ? { ...lens, projection: "pinhole" } : undefined,
    prior: x && y ? { near: [Number(x), Number(y), null], radius: Number(radius) || RADIUS } : undefined,
  };
}

async function* linesOf(body: ReadableStream<Uint8Array>): AsyncGenerator<string> {
  const reader = body.getReader();
  const decoder = new TextDecoder();
  let rest = "";
  for (;;) {
    const { done, value } = await reader.read();
    const lines = (rest + decoder.decode(value, { stream: !done })).split("\n");
    rest = lines.pop()!;
    yield* lines;
    if (done) return;
  }
}
