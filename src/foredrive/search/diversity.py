"""Selection of a few diverse or representative vectors."""

import numpy as np
from jaxtyping import Float
from numpy import ndarray


def k_centre(vectors: Float[ndarray, "n D"], count: int, worth: Float[ndarray, "n"]) -> list[int]:
    """Choose greedily the vector with the largest distance to the chosen ones times its worth (> 0).

    With equal worth this is the greedy 2-approximation of the k-centre problem (Gonzalez 1985; Sener &
    Savarese 2018). The first choice has the largest worth; among equals it is the first.

    Args:
        vectors: unit vectors. Distances are Euclidean.
        count: number to choose, at most n.
    """
    if not len(vectors):
        return []
    chosen = [int(worth.argmax())]
    distance = np.full(len(vectors), np.inf)
    while len(chosen) < min(count, len(vectors)):
        likeness = vectors @ vectors[chosen[-1]]
        distance = np.minimum(distance, np.sqrt(np.maximum(2 - 2 * likeness, 0.0)))
        gain = distance * worth
        gain[chosen] = -1.0
        chosen.append(int(gain.argmax()))
    return chosen


def facility_location(vectors: Float[ndarray, "n D"], count: int, worth: Float[ndarray, "n"]) -> list[int]:
    """Choose greedily the vector that adds most to Σ_i worth_i max_{j chosen} (1 + cos(i, j)) / 2.

    The sum measures how well the chosen vectors represent all. It is monotone and submodular, so the greedy
    result is within 1 - 1/e of the optimum (Nemhauser et al. 1978).

    Args:
        vectors: unit vectors.
        count: number to choose, at most n.
    """
    likeness = (1 + vectors @ vectors.T) / 2
    covered = np.zeros(len(vectors))
    chosen: list[int] = []
    while len(chosen) < min(count, len(vectors)):
        gain = (worth[:, None] * np.maximum(likeness - covered[:, None], 0.0)).sum(0)
        gain[chosen] = -1.0
        chosen.append(int(gain.argmax()))
        covered = np.maximum(covered, likeness[:, chosen[-1]])
    return chosen
