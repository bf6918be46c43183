"""Which photos are matched with which: all with all while they are few, neighbours of a walk, those that look alike."""

from collections.abc import Callable, Sequence

import numpy as np

ALL = 50  # photos up to which every pair is matched
BESIDE = 10  # neighbours of a video's frame on either side
ALIKE = 20  # photos that each of many is matched with
LOOPS = 10  # that a frame of a video is matched with besides, since a walk may come back
WAYS = ("auto", "exhaustive", "sequential", "retrieval")
WORDS, SAMPLE = 64, 200  # of the vocabulary, and features of a photo that it is made from

Pair = tuple[int, int]


def way_for(count: int, video: bool) -> str:
    """How so many photos are matched if nobody says it."""
    if count <= ALL:
        return "exhaustive"
    return "sequential" if video else "retrieval"


def choose_pairs(count: int, way: str, alike: Callable[[], np.ndarray]) -> list[Pair]:
    """The pairs (i, j), i < j, to be matched, ascending.

    way: of WAYS, not "auto". alike: called if it is needed, how alike photos look, [count, count].
    """
    if way == "exhaustive":
        return [(i, j) for i in range(count) for j in range(i + 1, count)]
    pairs: set[Pair] = set()
    reach = BESIDE if way == "sequential" else 2  # the order of names is some hint for photos, too
    gaps = {*range(1, reach + 1), *(2**k for k in range(7) if way == "sequential")}
    for i in range(count):
        pairs |= {(i, i + gap) for gap in gaps if i + gap < count}
    # Of a video the likest frames are the neighbours, which are pairs already: what is asked for are places seen again.
    known = np.eye(count, dtype=bool)
    if way == "sequential":
        known[tuple(np.array(sorted(pairs)).T)] = True
    similar = np.where(known | known.T, -np.inf, alike())
    for i, row in enumerate(similar):
        nearest = np.argsort(-row, kind="stable")[: LOOPS if way == "sequential" else ALIKE]
        pairs |= {(min(i, int(j)), max(i, int(j))) for j in nearest if np.isfinite(row[j])}
    return sorted(pairs)


def likeness(descriptors: Sequence[np.ndarray], seed: int = 0) -> np.ndarray:
    """How alike photos look, [n, n] cosines, from SIFT descriptors [p, 128] of each.

    A vocabulary of WORDS is made from the photos themselves; each photo is the sum of what its features differ from
    their words (VLAD), with square roots and unit length.
    """
    from scipy.cluster.vq import kmeans2, vq

    rng = np.random.default_rng(seed)
    roots = [np.sqrt(np.asarray(d, np.float32)) for d in descriptors]
    some = [r[rng.permutation(len(r))[:SAMPLE]] for r in roots]
    pool = np.concatenate(some)
    if len(pool) < WORDS:
        return np.zeros((len(roots), len(roots)))
    words, _ = kmeans2(pool, WORDS, iter=10, minit="points", rng=rng)
    found = np.zeros((len(roots), WORDS, pool.shape[1]), np.float32)
    for photo, features in zip(found, roots, strict=True):
        if len(features):
            word, _ = vq(features, words)
            np.add.at(photo, word, features - words[word])
    found /= np.maximum(np.linalg.norm(found, axis=-1, keepdims=True), 1e-9)
    flat = found.reshape(len(roots), -1)
    flat /= np.maximum(np.linalg.norm(flat, axis=-1, keepdims=True), 1e-9)
    return (flat @ flat.T).astype(np.float64)
