/** Sends a photo to the service that served the page, and reads its answer line by line. */
import { RADIUS, text } from "./text";
import type { Photo, Pictures } from "./types";

export const LOST = 0; // the network, in place of a status of HTTP
export const REPLACED = 409;
export const TOO_LARGE = 413;
const NO_PICTURE = 422;
const LATE = 408;
const DONE = 200;
const FAILED = 500; // of one of several photos
const BUSY = 503;

/** What a person knows that a photo's file does not say, by the names of the dialog's fields; "" is unknown. */
export type Options = Record<string, string>;

export interface Found {
  photo: Photo;
  result: { cloud_sha256: string | null; status: string; error: string | null };
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

  get isUnreadable(): boolean {
    return this.status === NO_PICTURE && !this.needsField;
  }

  /** True of a picture that is no sphere, and says nothing of its lens. */
  get needsField(): boolean {
    return this.status === NO_PICTURE && this.message.includes("`fov_deg`");
  }

  get mayPass(): boolean {
    return this.status === LOST || this.status === LATE || this.status >= 500;
  }
}

/**
 * Localize photos in one request; each is found by itself, or throws a Refusal. `onSent` is told the part of them that was sent,
 * which fetch does not know.
 */
export function send(photos: [File, string][], options: object, signal: AbortSignal, onSent: (part: number) => void): Promise<Found>[] {
  const form = new FormData();
  for (const [file, name] of photos) form.append("picture", file, name);
  form.append("options", JSON.stringify(options));
  const request = new XMLHttpRequest();
  request.open("POST", "show");
  request.upload.addEventListener("progress", ({ loaded, total }) => onSent(loaded / total));
  signal.addEventListener("abort", () => request.abort());
  const answers = photos.map((_, index) => answerOf(request, 2 * index));
  request.send(form);
  return answers;
}

/** What a request answers of a photo: a line with what was found, and the next with its pictures. */
function answerOf(request: XMLHttpRequest, number: number): Promise<Found> {
  const line = (own: number) => (request.status === DONE ? parsed(request.responseText.split("\n")[own] ?? "") : null);
  const pictures = new Promise<{ pictures: Pictures; thumb: string }>((resolve, reject) => {
    request.addEventListener("loadend", () => {
      const last = line(number + 1);
      if (last && !last.error) resolve(last);
      else reject(new Error(last?.error));
    });
  });
  pictures.catch(() => undefined); // who asks for them hears it
  return new Promise((resolve, reject) => {
    const look = () => {
      if (request.responseText.split("\n", number + 2).length < number + 2) return;
      request.removeEventListener("progress", look); // the lines with pictures are long
      const found = line(number);
      if (found?.result?.error) reject(new Refusal(found.result.status === "failed" ? FAILED : NO_PICTURE, found.result.error));
      else if (found?.photo) resolve({ ...found, pictures });
    };
    request.addEventListener("progress", look);
    request.addEventListener("loadend", () => {
      look();
      reject(refusalOf(request)); // unless it was found
    });
  });
}

function refusalOf(request: XMLHttpRequest): Refusal {
  const { status } = request;
  if (status === 0 || status === DONE) return new Refusal(LOST, text.drop.lost);
  const wait = status === BUSY ? Number(request.getResponseHeader("Retry-After")) || 5 : null;
  return new Refusal(status, parsed(request.responseText)?.error ?? text.drop.answered(status), wait);
}

/** What a line of JSON says; null for another, as of a proxy. */
function parsed(line: string) {
  try {
    return JSON.parse(line);
  } catch {
    return null;
  }
}

/** Options as the service reads them: those of the lens are for photos that are not spheres, and a field is known about. */
export function asJson({ fov, focal, x, y, radius, accuracy }: Options, isSphere: boolean, together: boolean): object {
  const lens = focal ? { focal_px: Number(focal) } : { fov_deg: Number(fov), refine_focal: true };
  return {
    photo: (fov || focal) && !isSphere ? { ...lens, projection: "pinhole" } : undefined,
    prior: x && y ? { near: [Number(x), Number(y), null], radius: Number(radius) || RADIUS } : undefined,
    accuracy: accuracy ? { metres: Number(accuracy) } : undefined,
    together: together || undefined,
  };
}
