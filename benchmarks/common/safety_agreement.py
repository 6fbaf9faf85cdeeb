"""Agreement of drives in a reconstruction with those in the town: figures of pairs, with intervals.

Intervals hold 95 %. They are percentiles over draws of whole places with replacement: what comes at one place
at several times, to all agents, is alike. Where all outcomes agree, draws have no spread: kappa has no
interval then, and agreement the exact one (Clopper and Pearson 1934), as if pairs were independent.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64
from scipy import stats

from benchmarks.common.safety_pairs import Pair
from foredrive.methods.reconstruction.trust import TRUSTED_LOSS_DB

RESAMPLES = 1_000
TRUE_DRIVES = 30
"""Number of drives in the town of the estimate by control variates."""


def agreement(pairs: Sequence[Pair]) -> dict[str, float]:
    """Return the figures of pairs. Those with a failed drive are counted and left out.

    A figure without a value, such as a correlation without spread, is left out; so is its interval.
    """
    whole = [pair for pair in pairs if pair.town.score is not None and pair.reconstructed.score is not None]
    figures = {"pairs": float(len(whole)), "failed": float(len(pairs) - len(whole))}
    if not whole:
        return figures
    figures |= {"tests": float(len({pair.test for pair in whole}))} | _values(whole)
    rng = np.random.default_rng(0)
    by_place: dict[str, list[Pair]] = {}
    for pair in whole:
        by_place.setdefault(place_of(pair.test), []).append(pair)
    places = list(by_place.values())
    figures["places"] = float(len(places))
    if len(places) < 2:
        return figures
    drawn: dict[str, list[float]] = {}
    for _ in range(RESAMPLES):
        chosen = rng.integers(len(places), size=len(places))
        sample = [pair for index in chosen for pair in places[index]]
        for name, value in _values(sample).items():
            drawn.setdefault(name, []).append(value)
    for name, values in drawn.items():
        # A figure that many draws do not have, for want of spread, has no interval
        if name in figures and len(values) >= 0.9 * RESAMPLES:
            figures[f"{name}_low"], figures[f"{name}_high"] = map(float, np.quantile(values, (0.025, 0.975)))
    if figures["collision_agreement"] == 1.0:
        exact = stats.binomtest(len(whole), len(whole)).proportion_ci(0.95, "exact")
        figures["collision_agreement_low"], figures["collision_agreement_high"] = exact.low, exact.high
        for end in ("low", "high"):
            figures.pop(f"kappa_{end}", None)
    return figures | control_variate(scores_of(whole), rng)


def place_of(test: str) -> str:
    """Return where and when in a log a test begins: its name is TOWN/KIND-SCENE_STARTs_IMPACTs_SPEEDmps."""
    town, _, label = test.partition("/")
    return f"{town}/{'_'.join(label.partition('-')[2].split('_')[:-2])}"


def scores_of(pairs: Sequence[Pair]) -> Float64[np.ndarray, "P 2"]:
    """Return the scores in the town and in the reconstruction."""
    return np.array([[pair.town.score, pair.reconstructed.score] for pair in pairs], dtype=float)


def _values(pairs: Sequence[Pair]) -> dict[str, float]:
    """Return the figures of some pairs, without intervals."""
    town, rebuilt = np.array(
        [[drive.outcome == "collided" for drive in (pair.town, pair.reconstructed)] for pair in pairs]
    ).T
    scores = scores_of(pairs)
    away_m = np.array([[pair.town.min_distance_m, pair.reconstructed.min_distance_m] for pair in pairs])
    same = town == rebuilt
    values = {
        "collision_agreement": float(same.mean()),
        "majority_agreement": majority_agreement(pairs),
        "outcome_agreement": float(np.mean([p.town.outcome == p.reconstructed.outcome for p in pairs])),
        "collisions_in_town": float(town.mean()),
        "collisions_in_rebuild": float(rebuilt.mean()),
        "score_in_town": float(scores[:, 0].mean()),
        "score_in_rebuild": float(scores[:, 1].mean()),
        "score_bias": float((scores[:, 1] - scores[:, 0]).mean()),
        "score_difference": float(np.abs(scores[:, 0] - scores[:, 1]).mean()),
        "min_distance_difference_m": float(np.median(np.abs(away_m[:, 0] - away_m[:, 1]))),
    }
    # Cohen's kappa: the share of what chance does not explain, with the collision rate of each world
    by_chance = float(town.mean() * rebuilt.mean() + (1 - town.mean()) * (1 - rebuilt.mean()))
    if by_chance < 1:
        values["kappa"] = (float(same.mean()) - by_chance) / (1 - by_chance)
    for name, columns in (("score", scores), ("min_distance", away_m)):
        if (np.ptp(columns, axis=0) > 0).all() and np.isfinite(columns).all():
            values[f"{name}_correlation"] = float(stats.pearsonr(*columns.T).statistic)
    return values | _of_agents(pairs, scores) | _of_trust(pairs, same)


def majority_agreement(pairs: Sequence[Pair]) -> float:
    """Return how often a guess without any drive is right: what most other tests of agent and kind end in.

    What a reconstruction predicts beyond that is due to what the sensors showed.
    """
    collided: dict[tuple[str, str], list[bool]] = {}
    for pair in pairs:
        collided.setdefault((pair.agent, pair.kind), []).append(pair.town.outcome == "collided")
    right = 0
    for outcomes in collided.values():
        count, total = len(outcomes), sum(outcomes)
        # Each test is left out of its own majority; a tie counts as no collision
        right += sum(((total - outcome) > 0.5 * (count - 1)) == outcome for outcome in outcomes)
    return right / len(pairs)


def _of_agents(pairs: Sequence[Pair], scores: Float64[np.ndarray, "P 2"]) -> dict[str, float]:
    """Return whether both worlds rank the agents alike, by their mean scores."""
    agents = np.array([pair.agent for pair in pairs])
    means = np.array([scores[agents == agent].mean(0) for agent in np.unique(agents)])
    if len(means) < 3 or (np.ptp(means, axis=0) == 0).any():
        return {}
    return {
        "rank_agreement": float(stats.kendalltau(*means.T).statistic),
        "rank_correlation": float(stats.spearmanr(*means.T).statistic),
        "agent_score_difference": float(np.abs(means[:, 0] - means[:, 1]).mean()),
    }


def _of_trust(pairs: Sequence[Pair], same: np.ndarray) -> dict[str, float]:
    """Return agreement by how good the images were expected to be, and how good they were."""
    lost_db = np.array([pair.reconstructed.lost_db for pair in pairs], dtype=float)
    ends = np.array(
        [[pair.reconstructed.last_expected_db, pair.reconstructed.last_true_db] for pair in pairs],
        dtype=float,
    )
    if not np.isfinite(lost_db).all():
        return {}
    trusted = lost_db <= TRUSTED_LOSS_DB
    values = {
        "lost_db": float(lost_db.mean()),
        "trusted_pairs": float(trusted.mean()),
        "calibration_error_db": float(np.abs(ends[:, 0] - ends[:, 1]).mean()),
        "true_psnr_db": float(ends[:, 1].mean()),
    }
    for name, rows in (("trusted", trusted), ("untrusted", ~trusted)):
        if rows.any():
            values[f"agreement_{name}"] = float(same[rows].mean())
    if not same.all() and same.any():
        above = stats.mannwhitneyu(lost_db[~same], lost_db[same]).statistic
        values["auc_disagreement"] = float(above / same.sum() / (~same).sum())
    return values


def control_variate(
    scores: Float64[np.ndarray, "P 2"], rng: np.random.Generator, resamples: int = RESAMPLES
) -> dict[str, float]:
    """Return how well few drives in the town and all in the reconstruction tell the mean score in the town.

    The estimate is the mean of `TRUE_DRIVES` drives in the town, corrected by how much the same tests differ
    in the reconstruction from all tests there, times the slope of the one on the other in these drives.

    Returns:
        The standard error of the plain mean and of the estimate, the bias of the latter, and the ratio of
        the mean squared errors. Empty with fewer than twice as many pairs.
    """
    if len(scores) < 2 * TRUE_DRIVES:
        return {}
    truth, everywhere = scores.mean(0)
    errors = []
    for _ in range(resamples):
        some = scores[rng.choice(len(scores), TRUE_DRIVES, replace=False)]
        covariance = np.cov(some.T)
        slope = covariance[0, 1] / covariance[1, 1] if covariance[1, 1] > 0 else 0.0
        plain = some[:, 0].mean()
        errors.append((plain - truth, plain + slope * (everywhere - some[:, 1].mean()) - truth))
    plain_error, error = np.array(errors).T
    return {
        "plain_standard_error": float(np.sqrt((plain_error**2).mean())),
        "control_variate_standard_error": float(np.sqrt((error**2).mean())),
        "control_variate_bias": float(error.mean()),
        "control_variate_error_ratio": float((error**2).mean() / (plain_error**2).mean()),
    }
