"""Regenerate image_forming_walks.csv: the light of a board that still arrives in its own image.

    python -m tests.reference.regenerate_image_forming

About three minutes of one core.  Random walks in endless homogeneous water, written for this
purpose in numpy alone: nothing of `oceaninv.MonteCarlo` is used, and of `oceaninv.phase` only the
values of Petzold's phase function.

A square board of half-size h stands at the distance r from the eye and faces it.  Walks start at
the eye towards the centre of the board.  A walk ends at its first hit of the board, on either face.
S is the share of walks, weighted by exp(-a path), that first hit the face towards the eye, and
M = S exp(c r): 1 without scattered light, above 1 with it (Duntley 1963, J. Opt. Soc. Am. 53:214,
on image-forming light; Mertens & Replogle 1977, J. Opt. Soc. Am. 67:1105, on its reciprocity).
`back` is the same for walks that first hit the other face, after they passed beside the board and
turned round.

The flight without scattering is not drawn: it adds exp(-c r) to S.  The first scattering of every
walk is drawn between the eye and the board, and the share of walks that do so, 1 - exp(-b r), is a
factor.  The same walks serve all sizes and both ratios a/b, so that those rows are correlated.
"""

import math
from pathlib import Path

import numpy as np

import oceaninv as oi

PATH = Path(__file__).with_name("image_forming_walks.csv")
SEED = 20261
LENGTHS = (0.1, 0.3, 0.6, 1.0, 2.0, 3.0)  # b r
SIZES = np.array([0.01, 0.02, 0.05, 0.1, 0.2, 0.3])  # h/r
ABSORPTION = np.array([0.25, 2.0])  # a/b
BATCH = 2**16
_ERROR = 5e-4  # of S, relative
_BINS = 2**16


def henyey_greenstein(theta, g: float = 0.9):
    """Share scattered by less than theta (rad)."""
    half = np.sin(theta / 2) ** 2
    root = np.sqrt((1 - g) ** 2 + 4 * g * half)
    # (1 - g^2)/(2 g) (1/(1 - g) - 1/root), without cancellation.
    return (1 + g) * 2 * half / (root * (root + 1 - g))


def junge(theta, slope: float):
    """Share scattered by less than theta: Fournier & Jonasz 1999 (SPIE 3761:62), for a cumulative
    Junge slope and the index that Mobley et al. 2002 (Appl. Opt. 41:1035) tie to it."""
    index = 1.01 + 0.1542 * (slope - 3)
    s = (slope - 3) / 2
    half = np.sin(theta / 2) ** 2

    def phi(delta):
        near = np.abs(delta - 1) < 1e-7
        safe = np.where(near, 2.0, delta)
        return np.where(near, s, (safe**s - 1) / (safe - 1))

    largest = 4 / (3 * (index - 1) ** 2)
    back = phi(np.asarray(largest))
    return 1 - (1 - half) * (phi(largest * half) - back * half * (1 - 2 * half) / 2)


def fournier_forand(theta, ratio: float):
    """`junge` with the slope whose share beyond 90 degrees is `ratio`."""
    low, high = 3.0 + 1e-9, 5.0
    right_angle = np.array(math.pi / 2)
    for _ in range(60):
        middle = (low + high) / 2
        above = 1 - junge(right_angle, middle) > ratio
        low, high = (low, middle) if above else (middle, high)
    return junge(theta, (low + high) / 2)


def tabulated(theta, table: oi.phase.Tabulated):
    """Share scattered by less than theta: the table, its first power law continued to 0."""
    angle, values = np.radians(table.angle_deg), np.exp(np.asarray(table.log_values, float))
    knots = np.geomspace(angle[0], math.pi, 200_001)
    density = np.exp(np.interp(np.log(knots), np.log(angle), np.log(values)))
    exponent = np.log(values[0] / values[1]) / np.log(angle[1] / angle[0])
    first = 2 * math.pi * values[0] * angle[0] ** 2 / (2 - exponent)
    ring = 2 * math.pi * density * np.sin(knots) * knots
    steps = np.diff(np.log(knots)) * (ring[1:] + ring[:-1]) / 2
    share = np.concatenate([[first], first + np.cumsum(steps)])
    inside = first * (np.minimum(theta, angle[0]) / angle[0]) ** (2 - exponent)
    beyond = np.interp(np.log(np.maximum(theta, angle[0])), np.log(knots), share)
    return np.where(theta < angle[0], inside, beyond) / share[-1]


def particles(theta, ratio: float):
    """Share scattered by less than theta: `oceaninv.water.bio_optics.particle_phase`, a mixture of
    the Fournier-Forand functions of bb/b 0.004 and 0.05."""
    share = (ratio - 0.004) / (0.05 - 0.004)
    return (1 - share) * fournier_forand(theta, 0.004) + share * fournier_forand(theta, 0.05)


PHASES = {
    "HG 0.9": henyey_greenstein,
    "Petzold": lambda theta: tabulated(theta, oi.phase.petzold()),
    "FF 0.010": lambda theta: fournier_forand(theta, 0.010),
    "FF 0.018": lambda theta: fournier_forand(theta, 0.018),
    "particles 0.010": lambda theta: particles(theta, 0.010),
    "particles 0.018": lambda theta: particles(theta, 0.018),
}


def angle_table(cumulative) -> np.ndarray:
    """Scattering angles (rad) at `_BINS` + 1 evenly spaced values of the cumulative function,
    which is evaluated at 400 angles a decade from 1e-12 rad on."""
    theta = np.concatenate([[0.0], np.geomspace(1e-12, math.pi, 5001)])
    share = np.concatenate([[0.0], cumulative(theta[1:])])
    share[-1] = 1.0
    share = np.maximum.accumulate(share)
    return np.interp(np.linspace(0.0, 1.0, _BINS + 1), share, theta)


def draw_angles(table: np.ndarray, u: np.ndarray) -> np.ndarray:
    place = u * _BINS
    index = place.astype(np.int64)
    return table[index] + (place - index) * (table[index + 1] - table[index])


def turned(direction: np.ndarray, theta: np.ndarray, azimuth: np.ndarray) -> np.ndarray:
    """(3, walk) unit vectors at the angle theta to `direction` (basis of Duff et al. 2017)."""
    x, y, z = direction
    sign = np.copysign(1.0, z)
    a = -1.0 / (sign + z)
    b = x * y * a
    sine = np.sin(theta)
    along, across, cosine = sine * np.cos(azimuth), sine * np.sin(azimuth), np.cos(theta)
    new = np.stack(
        [
            along * (1 + sign * x * x * a) + across * b + cosine * x,
            along * sign * b + across * (sign + y * y * a) + cosine * y,
            -along * sign * x - across * y + cosine * z,
        ]
    )
    return new / np.sqrt(np.sum(new**2, axis=0))


def walk_batch(rng, table, length: float, walks: int, absorption=ABSORPTION, sizes=SIZES):
    """(face, a/b, size, walk-sum) of scattered walks: sums of the weights that hit the front and
    the back of the board, and of their squares; distances in units of 1/b, r = `length`."""
    within = -math.expm1(-length)
    path = -np.log1p(-rng.random(walks) * within)
    number = np.arange(walks)
    position = np.zeros((3, walks))
    position[2] = path
    direction = np.zeros((3, walks))
    direction[2] = 1.0
    factor = np.full(walks, within)
    # Boards of half-size above `reach` were hit already; those below it are still free.
    reach = np.full(walks, np.inf)
    half = sizes * length
    found = np.zeros((2, len(absorption), len(sizes), walks))
    while len(number):
        theta = draw_angles(table, rng.random(len(number)))
        direction = turned(direction, theta, 2 * math.pi * rng.random(len(number)))
        step = -np.log1p(-rng.random(len(number)))
        ahead = length - position[2]
        with np.errstate(divide="ignore"):
            to_plane = ahead / direction[2]
        crosses = (to_plane > 0) & (to_plane <= step) & (ahead != 0)
        at = np.flatnonzero(crosses)
        offset = np.abs(position[:2, at] + to_plane[at] * direction[:2, at]).max(axis=0)
        forward = (direction[2, at] > 0).astype(int)
        travelled = path[at] + to_plane[at]
        for i, size in enumerate(half):
            hit = (offset < size) & (size < reach[at])
            for k, ratio in enumerate(absorption):
                weight = factor[at[hit]] * np.exp(-ratio * travelled[hit])
                found[1 - forward[hit], k, i, number[at[hit]]] += weight
        reach[at] = np.minimum(reach[at], offset)
        position = position + step * direction
        path = path + step
        # Roulette of the walks that carry little or are past the board; its factor is 2.
        poor = (factor * np.exp(-absorption[0] * path) < 0.3) | (position[2] > length)
        stays = ~poor | (rng.random(len(number)) < 0.5)
        factor = np.where(poor, 2 * factor, factor)
        keep = stays & (reach > half[0])
        number, path, factor, reach = (v[keep] for v in (number, path, factor, reach))
        position, direction = position[:, keep], direction[:, keep]
    return found.sum(axis=-1), (found**2).sum(axis=-1)


def reference(name: str, length: float, rng, error: float = _ERROR, most: int = 2**25):
    """M, its standard error and the back face's share: (3, a/b, size), and the walks drawn.  Walks
    are added until the relative standard error of every M is below `error`."""
    table = angle_table(PHASES[name])
    total = square = np.zeros((2, len(ABSORPTION), len(SIZES)))
    walks = 0
    straight = np.exp(-(1 + ABSORPTION) * length)[:, None]
    while True:
        sums, squares = walk_batch(rng, table, length, BATCH)
        total, square, walks = total + sums, square + squares, walks + BATCH
        mean = total / walks
        spread = np.sqrt(np.maximum(square / walks - mean**2, 0.0) / (walks - 1))
        share = straight + mean[0]
        if np.all(spread[0] < error * share) or walks >= most:
            break
    return np.stack([share, spread[0], mean[1]]) / straight, walks


def main():
    lines = []
    for p, name in enumerate(PHASES):
        for l, length in enumerate(LENGTHS):
            rng = np.random.default_rng([SEED, p, l])
            (whole, error, back), walks = reference(name, length, rng)
            for k, ratio in enumerate(ABSORPTION):
                for i, size in enumerate(SIZES):
                    row = whole[k, i], error[k, i], back[k, i]
                    numbers = ",".join(f"{v:.6g}" for v in row)
                    lines.append(f"{name},{length:g},{size:g},{ratio:g},{numbers},{walks}")
            print(*lines[-len(SIZES) * len(ABSORPTION) :], sep="\n", flush=True)
    header = [
        "# title: Light of a square board that arrives within its image, M = S exp(c r)",
        "# source: random walks (tests/reference/regenerate_image_forming.py), seed"
        f" [{SEED}, phase, length], walks as given per row",
        "# columns: phase; b r; half-size over range; a/b; M; its standard error; M of the back"
        " face; walks",
        "phase,b_r,h_over_r,a_over_b,M,stderr,M_back,walks",
    ]
    PATH.write_text("\n".join([*header, *lines]) + "\n")


if __name__ == "__main__":
    main()
