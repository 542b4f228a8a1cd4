/** What a report's data hold: see piccolo/report/build.py and entries.py, which write them. */

/** A photo that was dropped is waiting until the service has answered. */
export type Status = "localized" | "ambiguous" | "not_localized" | "unreadable" | "waiting";
export const STATUSES: readonly Status[] = ["localized", "ambiguous", "not_localized", "unreadable", "waiting"];
export type Vector = [number, number, number];

export interface Pose {
  /** Of the camera, in the frame of the plans [m], z up. */
  center: Vector;
  /** R_cam_from_plan, row by row; camera axes +x image centre, +y left, +z up. */
  rotation: number[];
  world: Vector;
  worldRotation: number[];
  /** Heading, pitch, roll [deg], in the world. */
  angles: Vector;
}

export interface Alternative {
  pose: Pose;
  score: number;
  probability: number;
  scan: string | null;
  storey: number | null;
}

export interface Spread {
  /** Half axes [m] and direction of the larger one, counterclockwise from +x [deg], of 95 %. */
  ellipse: Vector;
  /** Of the turn about the camera's axes [rad] and the position on the plan [m]: rows from the diagonal on. */
  covariance: number[];
  deg: Vector;
  largest: number;
  direction: string;
}

export interface Evidence {
  score: number;
  margin: number;
  explained_fraction: number;
  seen_fraction: number;
  contradicted_fraction: number;
  num_matches: number | null;
}

/** What may be told of a photo: reasons of piccolo/judge/reasons.py. */
export type Told = "nowhere" | "within" | "near" | "height" | "heading" | "calibration" | "camera";

export interface Photo {
  /** Its path below the folder that all share, which no other has; and as short as it can be told apart. */
  name: string;
  short: string;
  key: string;
  status: Status;
  confidence: number;
  /** That its place is right, however exact it is. */
  placeProbability: number;
  /** Metres and degrees that the confidence is of; null where it is not known. */
  accuracy: [number, number] | null;
  hint: string | null;
  probabilityNone: number | null;
  error: string | null;
  warnings: string[];
  /** What was told of the photo that can't be right; of one that is localized nothing. */
  contradicts: Told[];
  /** In place of the words for its status, if these are too wide. */
  verdict?: string;
  scan: string | null;
  /** Names of the photos by which it was found too. */
  beside: string[];
  captured: string | null;
  size: [number, number] | null;
  walk: number | null;
  time: number | null;
  /** True if nobody can have walked there from the frame before. */
  gap: boolean;
  /** False where there is no pose, or a best guess that is hopeless. */
  isOnPlan: boolean;
  pose: Pose | null;
  storey: number | null;
  height: number | null;
  alternatives: Alternative[];
  evidence: Evidence | null;
  spread: Spread | null;
  hasPictures: boolean;
  thumb: string | null;
}

export interface Plan {
  file: string;
  width: number;
  height: number;
  /** a, b, c, d, e, f of x = a u + c v + e, y = b u + d v + f [m] of pixels (u, v). */
  matrix: [number, number, number, number, number, number];
  pixel: number;
}

export interface Storey {
  name: string;
  floor: number;
  level: number;
  plan: Plan | null;
}

export interface Report {
  format: string;
  version: string;
  title: string;
  cloud: string;
  crs: string;
  /** What is wrong with all of it, in words; empty if nothing is. */
  note: string;
  north: [number, number] | null;
  /** Of the plan's frame: x_plan = R (x_world - origin), R row by row. */
  origin: Vector;
  R: number[];
  storeys: Storey[];
  photos: Photo[];
  /** Only where a service serves the page: the largest request that it takes, and the scan that it has. */
  service?: { maxBytes: number; keepsPhotos: boolean };
  scanSha256?: string;
}

export interface Pictures {
  sphere: string;
  scan?: string;
  mask?: string;
  /** Ranges of the scan, packed. */
  depth?: string;
  alternatives?: (string | null)[];
}

declare global {
  interface Window {
    PICCOLO_REPORT?: Report;
    PICCOLO_PHOTOS?: Record<string, Pictures | Promise<Pictures>>;
  }
}
