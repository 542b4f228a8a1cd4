/** Sends a photo to the service that served the page, and reads what it finds line by line. */
import { text } from "./text";
import type { Photo, Pictures } from "./types";

export const LOST = 0; // in place of a status of HTTP: the network's
export const REPLACED = 409;
export const TOO_LARGE = 413;
const BUSY = 503;
const PATIENCE = 5; // s, where a busy service does not say how long

/** What is known of a photo that its file does not say; empty is unknown. */
export interface Options {
  fov?: number;
  focal?: number;
  x?: number;
  y?: number;
  radius?: number;
}

export interface Found {
  photo: Photo;
  result: { cloud_sha256: string | null };
  /** Come a little later. */
  pictures: Promise<{ pictures: Pictures; thumb: string }> | null;
}

/** Why there is no result; `seconds` after which to ask again, if the service is busy. */
export class Refusal extends Error {
  constructor(
    readonly status: number,
    words: string,
    readonly seconds: number | null = null,
  ) {
    super(words);
  }

  get mayPass(): boolean {
    return this.status === LOST || this.status >= 500;
  }
}

/** Localize a photo; the camera's options count for photos that are not spheres. */
export async function send(file: File, options: Options, isSphere: boolean, signal: AbortSignal): Promise<Found> {
  const form = new FormData();
  form.append("picture", file);
  const told = JSON.stringify(asJson(options, isSphere));
  if (told !== "{}") form.append("options", told);
  try {
    const response = await fetch("show", { method: "POST", body: form, signal });
    if (!response.ok) throw await refusalOf(response);
    const lines = linesOf(response.body!);
    const next = async () => JSON.parse((await lines.next()).value as string);
    const { photo, result } = await next();
    return { photo, result, pictures: photo.hasPictures ? next() : null };
  } catch (error) {
    throw error instanceof Refusal ? error : new Refusal(LOST, text.drop.lost);
  }
}

function asJson({ fov, focal, x, y, radius }: Options, isSphere: boolean): object {
  const lens = { fov_deg: fov, focal_px: focal, projection: "pinhole" };
  const isNear = x !== undefined && y !== undefined;
  return {
    photo: !isSphere && (fov || focal) ? lens : undefined,
    prior: isNear ? { near: [x, y, null], radius: radius || 5 } : undefined,
  };
}

async function refusalOf(response: Response): Promise<Refusal> {
  const said = (await response.json().catch(() => ({}))) as { error?: string };
  const wait = Number(response.headers.get("Retry-After")) || PATIENCE;
  return new Refusal(response.status, said.error ?? response.statusText, response.status === BUSY ? wait : null);
}

async function* linesOf(body: ReadableStream<Uint8Array>): AsyncGenerator<string> {
  const reader = body.getReader();
  const decoder = new TextDecoder();
  let rest = "";
  for (;;) {
    const { done, value } = await reader.read();
    const lines = (rest + decoder.decode(value, { stream: !done })).split("\n");
    rest = lines.pop()!;
    yield* lines.filter(Boolean);
    if (done) return;
  }
}
