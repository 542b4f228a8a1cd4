"""A NumPy twin of every kernel, float64, by another formula where there is one."""

import math

import numpy as np

from piccolo.geometry.sphere import find_cell, make_grid


def project(points, R_cam_from_world, center_world, width):
    """Pixels (N, 2) of world points (N, 3); elevation by the arcsine of the unit direction."""
    x, y, z = R_cam_from_world @ (np.asarray(points, dtype=np.float64) - center_world).T
    elevation = np.arcsin(z / np.linalg.norm([x, y, z], axis=0))
    return width * np.stack([0.5 - np.arctan2(y, x) / math.tau, 0.25 - elevation / math.tau], axis=1)


def sample(image, pixels):
    """Bilinear values (N, C) of an image (H, W, C) at continuous pixels (N, 2): columns wrap, rows clamp."""
    height, width = image.shape[:2]
    u, v = pixels[:, 0] - 0.5, pixels[:, 1] - 0.5
    j = np.floor(u).astype(int)
    i = np.floor(v).astype(int)
    fu = (u - j)[:, None]
    fv = (v - i)[:, None]

    def at(row, column):
        return image[np.clip(row, 0, height - 1), column % width].astype(np.float64)

    top = (1 - fu) * at(i, j) + fu * at(i, j + 1)
    bottom = (1 - fu) * at(i + 1, j) + fu * at(i + 1, j + 1)
    return (1 - fv) * top + fv * bottom


def color_differences(points, colors, pose, rgb, num_columns, slack):
    """How much the colours (M, 3) of the points that an image shows differ from its own.

    Shown are those at most a fraction `slack`, and as many metres, behind the nearest in their cell.
    """
    R_cam_from_world, center_world = pose.R_cam_from_world, pose.center_world
    depth = nearest_depth(points, R_cam_from_world, center_world, num_columns)
    pixels = project(points, R_cam_from_world, center_world, rgb.shape[1])
    cells = (pixels * num_columns / rgb.shape[1]).astype(int)
    u, v = np.minimum(cells, [num_columns - 1, num_columns // 2 - 1]).T
    is_shown = np.linalg.norm(points - center_world, axis=1) <= depth[v, u] * (1.0 + slack) + slack
    return np.abs(sample(rgb, pixels[is_shown]) - colors[is_shown])


def sampling_loss(points, colors, image, is_valid, R_cam_from_world, center_world):
    """Eq. 2 of the paper; `image` (H, W, 3) and `colors` (N, 3) are 8-bit, the loss is in units of 1."""
    pixels = project(points, R_cam_from_world, center_world, image.shape[1])
    norms = np.linalg.norm(sample(image, pixels) - colors, axis=1) / 255.0
    counts = sample(is_valid[..., None].astype(np.float64), pixels)[:, 0] > 1.0 - 1e-9
    return norms[counts].mean()


def nearest_depth(points, R_cam_from_world, center_world, width):
    """Range of the nearest point in each cell (H, W), inf where there is none."""
    pixels = project(points, R_cam_from_world, center_world, width)
    depth = np.full((width // 2, width), np.inf)
    column = np.minimum(pixels[:, 0].astype(int), width - 1)
    row = np.minimum(pixels[:, 1].astype(int), width // 2 - 1)
    np.minimum.at(depth, (row, column), np.linalg.norm(points - center_world, axis=1))
    return depth


def interleave(cells):
    """Morton codes of cells (N, 3), bit by bit as text."""
    codes = []
    for cell in cells:
        digits = zip(*(format(int(index), "021b") for index in cell[::-1]), strict=True)
        codes.append(int("".join(digit for triple in digits for digit in triple), 2))
    return np.array(codes, dtype=np.int64)


def voxels(points, colors, size, corner):
    """Mean position and colour (M, 6) of each voxel of a grid with that corner, by a dictionary."""
    members = {}
    for point, color in zip(points, colors.astype(int), strict=True):
        voxel = tuple(int(k) for k in np.floor((point - corner) / size))
        members.setdefault(voxel, []).append((*point, *color))
    return np.array([np.mean(rows, axis=0) for rows in members.values()])


def nearest_box(origin, directions, boxes):
    """Range (N,) of the first of the boxes (B, 7) along each direction (N, 3): by planes, not by slabs."""
    best = np.full(len(directions), np.inf)
    for x, y, z, hx, hy, hz, yaw in boxes:
        c = math.cos(yaw)
        s = math.sin(yaw)
        to_box = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
        start = to_box @ (origin - [x, y, z])
        rays = directions @ to_box.T
        half = np.array([hx, hy, hz])
        for axis in range(3):
            for side in (-1.0, 1.0):
                with np.errstate(divide="ignore"):
                    at = (side * half[axis] - start[axis]) / rays[:, axis]
                hits = np.abs(start + at[:, None] * rays) <= half + 1e-12
                hits[:, axis] = True
                entering = side * rays[:, axis] < 0
                best = np.where(hits.all(axis=1) & (at > 1e-6) & entering & (at < best), at, best)
    return best


def cells_view(leaves, center, cell, num_cells):
    """Mean relative position, mean colour and count of each cell's front, of leaves (N, 6) in `cell` (N,)."""
    relative = leaves[:, :3] - center
    ranges = np.linalg.norm(relative, axis=1)
    nearest = np.full(num_cells, np.inf)
    np.minimum.at(nearest, cell, ranges)
    front = ranges <= 1.15 * nearest[cell]
    count = np.bincount(cell[front], minlength=num_cells)
    values = np.column_stack([relative, leaves[:, 3:]])[front]
    sums = np.stack([np.bincount(cell[front], v, minlength=num_cells) for v in values.T], axis=1)
    means = sums / np.maximum(count, 1)[:, None]
    return means[:, :3], means[:, 3:], count


def normalized_cells(rgb, is_seen, num_rings, stats_rings, sigma_deg):
    """Opponent channels (cells, 3) less their Gaussian local mean, by the local deviation, clipped to 2.

    The means and the inverse deviations at coarse cells, interpolated cell by cell.
    """
    fine, coarse = make_grid(num_rings), make_grid(stats_rings)
    r, g, b = rgb.T
    channels = np.stack([(r + g + b) / 3, (r - b) / 2, (2 * g - r - b) / 4], axis=1)
    moments = np.zeros((len(coarse), 7))
    rows = np.column_stack([np.ones(len(r)), channels, channels**2]) * (fine.solid_angle * is_seen)[:, None]
    np.add.at(moments, find_cell(fine.directions, stats_rings), rows)
    cosine = coarse.directions.astype(float) @ coarse.directions.T
    weight = np.exp((cosine - 1) / math.radians(sigma_deg) ** 2) * coarse.solid_angle
    weight[cosine <= math.cos(2.3 * math.radians(sigma_deg))] = 0
    sums = weight @ moments
    mean, square = (sums[:, k : k + 3] / np.maximum(sums[:, :1], 1e-12) for k in (1, 4))
    gain = 1.0 / np.sqrt(np.maximum(square - mean**2, 0) + 0.03**2)
    mean, gain = (between_cells(fine.directions, coarse_rings=stats_rings, values=v) for v in (mean, gain))
    return np.clip((channels - mean) * gain, -2, 2)


def between_cells(directions, coarse_rings, values):
    """Values of a grid's cells (M, 3) at directions (N, 3): linear along each ring, then between two."""
    grid = make_grid(coarse_rings)
    found = []
    for x, y, z in directions.astype(float):
        place = (math.pi / 2 - math.asin(max(-1.0, min(1.0, z)))) / math.pi * coarse_rings - 0.5
        along = []
        for beside in (math.floor(place), math.floor(place) + 1):
            ring = min(max(beside, 0), coarse_rings - 1)
            n, first = int(grid.num_columns[ring]), int(grid.first[ring])
            column = (math.atan2(y, x) / math.tau + (0.5 if ring == beside else 1.0)) * n - 0.5
            part = column - math.floor(column)
            a, b = values[first + math.floor(column) % n], values[first + (math.floor(column) + 1) % n]
            along.append((1.0 - part) * a + part * b)
        part = place - math.floor(place)
        found.append((1.0 - part) * along[0] + part * along[1])
    return np.array(found)


def splat(discs, rgb, width, min_radius_px, max_slope, band, band_offset):
    """Range (H, W) and colour (H, W, 3) of discs (N, 9), each pixel's ray against every disc."""
    azimuth = math.pi - (np.arange(width) + 0.5) * math.tau / width
    elevation = math.pi / 2 - (np.arange(width // 2) + 0.5) * math.tau / width
    level = np.cos(elevation)[:, None]
    ray_z = np.broadcast_to(np.sin(elevation)[:, None], (width // 2, width))
    rays = np.stack([level * np.cos(azimuth), level * np.sin(azimuth), ray_z], axis=-1)[..., None, :]
    center, normal = discs[:, :3], discs[:, 3:6]
    distance = np.linalg.norm(center, axis=1)
    t = (center * normal).sum(axis=1) / (rays * normal).sum(axis=-1)
    q = np.linalg.norm(t[..., None] * rays - center, axis=-1) ** 2 * discs[:, 7]
    is_met = (t > 0) & (q < 1)
    by_pixel = 2 * (1 - (rays * center).sum(axis=-1) / distance) / (min_radius_px * math.tau / width) ** 2
    q = np.minimum(np.where(is_met, q, 2), by_pixel)
    t = np.clip(np.where(t > 0, t, distance), distance / max_slope, distance * max_slope)
    nearest = np.where(q < 1, t, np.inf).min(axis=-1, keepdims=True)
    weight = ((1 - np.minimum(q, 1)) ** 3 + 1e-4) * ((q < 1) & (t <= nearest * band + band_offset))
    total = np.maximum(weight.sum(axis=-1), 1e-12)
    depth = np.where(weight.sum(axis=-1) > 0, (weight * t).sum(axis=-1) / total, np.inf)
    return depth, weight @ rgb / total[..., None]


def misplaced(nodes, first_child, level_start, origin, leaf_size):
    """Whether each node of an octree lies in another voxel of the grid than its parent, by whole numbers."""
    parent = np.repeat(np.arange(len(nodes)), np.diff(first_child))
    children = np.arange(level_start[1], len(nodes))
    level = np.searchsorted(level_start, parent, side="right") - 1
    size = leaf_size * 2.0 ** (len(level_start) - 2 - level)[:, None]
    places = (np.array([nodes[children, :3], nodes[parent, :3]]) + origin) / size
    is_near_border = np.abs(places - np.rint(places)).max(axis=0) < 1e-3
    return ((np.floor(places[0]) != np.floor(places[1])) & ~is_near_border).any(axis=1)


def view_positions(centers, ranges, num_rings):
    """Indices of the positions kept, one after another by lists; 2.5 m, 2.4 m, 1 m as in the module."""
    cells = [tuple(np.floor(c / [2.5, 2.5, 3.0])) for c in centers]
    lowest = {cell: min(c[2] for c, own in zip(centers, cells, strict=True) if own == cell) for cell in cells}
    off = [abs(c[2] - lowest[cell] - 1.0) for c, cell in zip(centers, cells, strict=True)]
    kept = []
    for i in sorted(range(len(centers)), key=lambda i: round(off[i] / 0.3)):
        for j in kept:
            gap = centers[i] - centers[j]
            row = int((90.0 - math.degrees(math.atan2(gap[2], math.hypot(*gap[:2])))) / 3.75)
            column = int((180.0 + math.degrees(math.atan2(gap[1], gap[0]))) / 3.75)
            middle = np.radians([(column + 0.5) * 3.75 - 180.0, 90.0 - (row + 0.5) * 3.75])
            level = math.cos(middle[1])
            ray = np.array([[level * math.cos(middle[0]), level * math.sin(middle[0]), math.sin(middle[1])]])
            limit = ranges[j, find_cell(ray.astype(np.float32), num_rings)[0]]
            is_near = math.hypot(*gap[:2]) < 2.5 and abs(gap[2]) < 2.4
            if is_near and (limit == 0 or np.linalg.norm(gap) < limit + 1.0):
                break
        else:
            kept.append(i)
    return kept


def block_correlation(first, second, shared, blocks, num_blocks):
    """Correlation and area (blocks,) of channels (3, N) over weights (N,)."""
    correlation, area = np.zeros(num_blocks), np.zeros(num_blocks)
    for b in range(num_blocks):
        w = shared[blocks == b]
        x = first[:, blocks == b]
        y = second[:, blocks == b]
        area[b] = w.sum()
        energy = (w * x**2).sum() * (w * y**2).sum()
        correlation[b] = (w * x * y).sum() / math.sqrt(energy) if energy > 1e-12 else 0.0
    return correlation, area


def centered_correlation(features, seen, samples, validity, area, flat, least_seen):
    """Correlations (views, rotations) of channels (n, 3, cells) around their means over shared cells.

    A view's channels are multiplied by the fraction seen (views, cells) already. All sums are weighted by
    that fraction. Deviations count as `flat` at least; the correlation is multiplied by the root of the
    fraction seen of what the photo shows, and is 0 if that is at most `least_seen`.
    """
    found = np.zeros((len(features), len(samples)))
    for i, f in enumerate(features.astype(float)):
        for r, s in enumerate(samples.astype(float)):
            shown = area * validity[r]
            weight = shown * seen[i]
            total = weight.sum()
            part = total / shown.sum()
            if part <= least_seen:
                continue
            view = f / np.maximum(seen[i], 1e-9)
            view = view - (weight * view).sum(axis=1, keepdims=True) / total
            photo = s - (weight * s).sum(axis=1, keepdims=True) / total
            product = (weight * view * photo).sum()
            of_view = (weight * view * view).sum()
            of_photo = (weight * photo * photo).sum()
            norm = math.sqrt(max(of_view, flat**2 * total) * max(of_photo, flat**2 * total))
            found[i, r] = product / norm * math.sqrt(part)
    return found


def votes(matches, R_cam_from_map, center_map):
    """Count the features that have a match within 20 deg, 1.7 in size, 40 deg in turn."""
    agreeing = set()
    for k in range(len(matches.query)):
        seen = R_cam_from_map @ (matches.points[k].astype(float) - center_map)
        distance = np.linalg.norm(seen)
        off = math.acos(min(seen @ matches.rays[k] / distance, 1.0))
        ratio = math.log(matches.sizes[k] / (distance * matches.angles[k]))
        turn = math.acos(np.clip(R_cam_from_map @ matches.tangents[k] @ matches.ray_tangents[k], -1.0, 1.0))
        if off < math.radians(20.0) and abs(ratio) < math.log(1.7) and turn < math.radians(40.0):
            agreeing.add(int(matches.query[k]))
    return len(agreeing)


def profile(leaves, place, radius):
    """Normal (3,) and place of a patch of leaves (N, 3), and their counts (39,) by height."""
    offsets = leaves.astype(np.float64) - place

    def in_disc(normal):
        heights = offsets @ normal
        return heights, np.linalg.norm(offsets - heights[:, None] * normal, axis=1) < radius

    near = offsets[np.linalg.norm(offsets, axis=1) < radius]
    normal = np.linalg.eigh(np.cov(near.T))[1][:, 0]
    for _ in range(2):
        heights, is_over = in_disc(normal)
        bins = np.floor(heights[is_over] / 0.005 + 0.5)
        totals = [np.count_nonzero(np.abs(bins - k) <= 1) for k in range(-4, 5)]
        is_sheet = is_over & (np.abs(heights - 0.005 * (np.argmax(totals) - 4)) < 0.0125)
        normal = np.linalg.eigh(np.cov(offsets[is_sheet].T))[1][:, 0]
    heights, is_over = in_disc(normal)
    sheet = offsets[is_sheet].mean(axis=0) @ normal
    is_over &= np.abs(heights - sheet) < 0.0975
    bins = np.floor((heights[is_over] - sheet) / 0.005 + 0.5).astype(int) + 19
    return normal, place + sheet * normal, np.bincount(bins, minlength=39)


def spread_votes(votes, guide, reach, near, alike):
    """Sums of votes (H, W, 2) around each cell: each cell gives its votes to all others, by two Gaussians."""
    height, width = votes.shape[:2]
    row, column = (index.ravel() for index in np.indices((height, width)))
    down = np.abs(row[:, None] - row)
    across = np.abs(column[:, None] - column)
    across = np.minimum(across, width - across)
    colors = guide.reshape(-1, 3).astype(np.float64)
    unlike = np.linalg.norm(colors[:, None] - colors, axis=2)
    weights = np.exp(-(down**2 + across**2) / (2 * near**2)) * np.exp(-(unlike**2) / (2 * alike**2))
    weights[(down > reach) | (across > reach)] = 0.0
    return (weights @ votes.reshape(-1, 2)).reshape(votes.shape)
