/** Points on the scan's surfaces, by its depth as a photo sees it, and the distance between two of them. */
import type { Photo, Vector } from "./types";

/** Ranges [m] of a sphere around the camera, row by row; 0 where nothing was scanned. */
export interface Depth {
  width: number;
  ranges: Float32Array;
}

/** What was pointed at: a direction of a photo's camera, and the deviation of the pointing [rad]. */
export interface Spot {
  photo: number;
  ray: Vector;
  angle: number;
}

/** Where its ray meets the scan, in the frame of the plans. */
export interface Point {
  spot: Spot;
  at: Vector;
  /** Covariance (3, 3) of its own error [m2], by pointing and surface. */
  own: number[][];
  /** Its derivative (3, 6) by the pose: turn about the camera's axes, then position. */
  byPose: number[][];
  isAtEdge: boolean;
}

/** The direction of a pixel's centre, and its range [m], 0 where nothing was scanned. */
type Sample = [ray: Vector, range: number];

const WINDOW = 7; // px, around the ray's own, whose ranges tell the surface
const MIDDLE = (WINDOW * WINDOW - 1) / 2; // the ray's own of them
const LEAST_PIXELS = 8; // of them on the surface
const MOST_SLOPE = 6.6; // of a surface against what is square to the ray: 81 degrees
const JUMP = [0.012, 0.006]; // m, and by the range: what is farther off a surface is another
const NOISE = 0.002; // m, of a scan's surface, at least
const BLUR = 0.3; // px of the depth, beside the deviation of a ray, within which an edge counts
const EDGE = 0.02; // m, by which an edge makes a point uncertain, to be told

const dot = (a: number[], b: number[]) => a.reduce((sum, value, k) => sum + value * b[k], 0);
const transposed = (a: number[][]) => a[0].map((_, j) => a.map((row) => row[j]));
const times = (a: number[][], b: number[][]) => a.map((row) => transposed(b).map((column) => dot(row, column)));
const crossing = ([x, y, z]: number[]) => [[0, -z, y], [z, 0, -x], [-y, x, 0]];

/** R_cam_from_plan (3, 3) of a photo's pose. */
const matrixOf = ({ pose }: Photo) => [0, 3, 6].map((k) => pose!.rotation.slice(k, k + 3));

/** A direction of the plan's frame in a photo's camera. */
export const inCamera = (photo: Photo, ray: Vector) => matrixOf(photo).map((row) => dot(row, ray)) as Vector;

/** The pixels around a camera's direction, row by row. */
export function samplesAround({ width, ranges }: Depth, [x, y, z]: Vector): Sample[] {
  const column = Math.floor((0.5 - Math.atan2(y, x) / (2 * Math.PI)) * width);
  const row = Math.floor((0.5 - Math.atan2(z, Math.hypot(x, y)) / Math.PI) * (width / 2));
  const stride = Math.max(1, Math.min(width / 16, Math.round(1 / Math.hypot(x, y, 1e-6)))); // of columns, wider at the poles
  return Array.from({ length: WINDOW * WINDOW }, (_, k) => {
    const i = row + Math.floor(k / WINDOW) - (WINDOW - 1) / 2;
    const j = Math.floor(column + stride * ((k % WINDOW) - (WINDOW - 1) / 2) + width) % width;
    const azimuth = (0.5 - (j + 0.5) / width) * 2 * Math.PI;
    const elevation = (0.5 - (i + 0.5) / (width / 2)) * Math.PI;
    const level = Math.cos(elevation);
    return [[level * Math.cos(azimuth), level * Math.sin(azimuth), Math.sin(elevation)], ranges[i * width + j] ?? 0];
  });
}

/** The plane m x = 1 through samples, by least squares of m ray = 1 / range; null if they tell none. */
function planeOf(samples: Sample[]): number[] | null {
  const rays = samples.map(([ray]) => ray);
  const N = times(transposed(rays), rays);
  const right = transposed(rays).map((column) => samples.reduce((sum, [, range], k) => sum + column[k] / range, 0));
  const adjugate = [0, 1, 2].map((i) => {
    const [a, b] = [N[(i + 1) % 3], N[(i + 2) % 3]];
    return crossing(a).map((row) => dot(row, b));
  });
  const determinant = dot(N[0], adjugate[0]);
  return determinant > 1e-13 * samples.length ** 3 ? adjugate.map((row) => dot(row, right) / determinant) : null;
}

/** The plane of the surface in the middle, which goes on over no jump. */
function surfaceOf(samples: Sample[], isOn: (sample: Sample, plane: number[]) => boolean): number[] {
  const [ray, range] = samples[MIDDLE];
  const nearest = (step: number) => {
    const beside = [samples[MIDDLE - step], samples[MIDDLE + step]].filter((sample) => sample[1]);
    return beside.sort((a, b) => Math.abs(a[1] - range) - Math.abs(b[1] - range)).slice(0, 1);
  };
  let plane = planeOf([samples[MIDDLE], ...nearest(1), ...nearest(WINDOW)]) ?? ray.map((value) => value / range);
  for (let round = 0; round < 3; round++) {
    const on = samples.filter((sample) => isOn(sample, plane));
    const better = on.length < LEAST_PIXELS || !on.includes(samples[MIDDLE]) ? null : planeOf(on);
    if (better && dot(better, ray) > 0) plane = better;
  }
  return plane;
}

/** The point that a spot of a photo shows; null where nothing was scanned. */
export function pointAt(spot: Spot, depth: Depth, photo: Photo): Point | null {
  const { ray, angle } = spot;
  const samples = samplesAround(depth, ray);
  if (!samples[MIDDLE][1]) return null;
  const seen = samples.filter((sample) => sample[1]);
  const off = ([other, range]: Sample, plane: number[]) => range - 1 / Math.max(dot(plane, other), 1e-6);
  const isOn = (sample: Sample, plane: number[]) => sample[1] > 0 && Math.abs(off(sample, plane)) < JUMP[0] + JUMP[1] * sample[1];
  const plane = surfaceOf(samples, isOn);
  const range = 1 / dot(plane, ray);
  const slope = plane.map((value, k) => value * range - ray[k]);
  const bound = Math.min(1, MOST_SLOPE / Math.hypot(...slope, 1e-9));
  // I - u n^T / (n^T u), as n is u + slope: what is shifted comes back to the surface along the ray
  const onto = ray.map((u, i) => ray.map((v, j) => Number(i === j) - u * (v + bound * slope[j])));
  const R = matrixOf(photo);
  const inPlan = times(transposed(R), onto);
  const byTurn = times(inPlan, crossing(ray));
  const byShift = times(inPlan, R);
  const byPose = byTurn.map((row, k) => [...row.map((value) => value * range), ...byShift[k]]);
  const covariance = covarianceOf(photo);
  const ofPose = covariance ? times(times(byPose, covariance), transposed(byPose)) : [[0, 0, 0], [0, 0, 0], [0, 0, 0]];
  // an edge counts by how much of what the ray may meet is off the surface
  const blur = angle ** 2 + (ofPose[0][0] + ofPose[1][1] + ofPose[2][2]) / 3 / range ** 2 + ((BLUR * 2 * Math.PI) / depth.width) ** 2;
  const weights = seen.map(([other]) => Math.exp((dot(other, ray) - 1) / blur));
  const squares = seen.map((sample) => off(sample, plane) ** 2);
  const on = seen.map((sample) => Number(isOn(sample, plane)));
  const edge = dot(weights, squares.map((square, k) => (on[k] ? 0 : square))) / dot(weights, weights.map(() => 1));
  const along = NOISE ** 2 + dot(squares, on) / Math.max(dot(on, on), 1) + edge;
  const pointing = times(inPlan, transposed(inPlan));
  const ahead = times(transposed(R), ray.map((value) => [value])).map(([value]) => value);
  return {
    spot,
    at: ahead.map((value, k) => photo.pose!.center[k] + range * value) as Vector,
    own: pointing.map((row, i) => row.map((value, j) => (range * angle) ** 2 * value + along * ahead[i] * ahead[j])),
    byPose,
    isAtEdge: edge > EDGE ** 2,
  };
}

/** The covariance (6, 6) of a photo's pose, as a point's `byPose` takes it; null if it is not known. */
function covarianceOf(photo: Photo): number[][] | null {
  const upper = photo.spread?.covariance;
  const place = (i: number, j: number): number => (i > j ? place(j, i) : 6 * i - (i * (i + 1)) / 2 + j);
  const six = [0, 1, 2, 3, 4, 5];
  return upper ? six.map((i) => six.map((j) => upper[place(i, j)])) : null;
}

/** How far two points are apart [m], and its deviation [m]: those of one photo share the error of its pose. */
export function distanceBetween(a: Point, b: Point, photos: Photo[]): { gap: number[]; metres: number; deviation: number | null } {
  const gap = b.at.map((value, k) => value - a.at[k]);
  const metres = Math.hypot(...gap);
  const along = gap.map((value) => value / Math.max(metres, 1e-9));
  const variance = (by: number[], matrix: number[][] | null) => (matrix ? dot(by, times([by], matrix)[0]) : NaN);
  const [ofA, ofB] = [a, b].map(({ spot }) => covarianceOf(photos[spot.photo]));
  const [byA, byB] = [a, b].map(({ byPose }) => times([along], byPose)[0]);
  const isShared = a.spot.photo === b.spot.photo;
  const ofPoses = isShared ? variance(byB.map((value, k) => value - byA[k]), ofA) : variance(byA, ofA) + variance(byB, ofB);
  const deviation = Math.sqrt(variance(along, a.own) + variance(along, b.own) + ofPoses);
  return { gap, metres, deviation: Number.isFinite(deviation) ? deviation : null };
}
