"""Random finite sets: a detector's word as a density over sets of objects, and how likely the truth is."""

from foredrive.sets.associations import AssociationSum, sum_associations
from foredrive.sets.boxes import BoxDensity, LabelledBoxes
from foredrive.sets.calibration import (
    ExistenceMap,
    Reliability,
    SetCalibration,
    conformal_factor,
    conformal_scores,
    fit_existence,
    fit_scale,
    fit_set_calibration,
    reliability,
)
from foredrive.sets.detections import objects_from_boxes, pmb_from_detections
from foredrive.sets.gospa import Gospa, gospa, wasserstein_distance
from foredrive.sets.likelihood import SetNll, set_nll
from foredrive.sets.processes import (
    MixturePoisson,
    MultiBernoulli,
    PoissonMultiBernoulli,
    PoissonProcess,
    SumPoisson,
    UniformPoisson,
    poisson_log_prob,
)
from foredrive.sets.proper_scores import brier, crps_gaussian, crps_laplace, energy_score, object_brier
from foredrive.sets.resampling import BootstrapMean, bootstrap_mean

__all__ = [
    "AssociationSum",
    "BootstrapMean",
    "BoxDensity",
    "ExistenceMap",
    "Gospa",
    "LabelledBoxes",
    "MixturePoisson",
    "MultiBernoulli",
    "PoissonMultiBernoulli",
    "PoissonProcess",
    "Reliability",
    "SetCalibration",
    "SetNll",
    "SumPoisson",
    "UniformPoisson",
    "bootstrap_mean",
    "brier",
    "conformal_factor",
    "conformal_scores",
    "crps_gaussian",
    "crps_laplace",
    "energy_score",
    "fit_existence",
    "fit_scale",
    "fit_set_calibration",
    "gospa",
    "object_brier",
    "objects_from_boxes",
    "pmb_from_detections",
    "poisson_log_prob",
    "reliability",
    "set_nll",
    "sum_associations",
    "wasserstein_distance",
]
