"""Random finite sets: densities over sets of objects, their likelihood and their calibration."""

from foredrive.sets.associations import AssociationSum, sum_associations
from foredrive.sets.boxes import BoxDensity, Family, LabelledBoxes
from foredrive.sets.calibration import (
    ExistenceMap,
    SetCalibration,
    conformal_factor,
    conformal_scores,
    fit_existence,
    fit_scale,
    fit_set_calibration,
)
from foredrive.sets.detections import objects_from_boxes, pmb_from_detections
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

__all__ = [
    "AssociationSum",
    "BoxDensity",
    "ExistenceMap",
    "Family",
    "LabelledBoxes",
    "MixturePoisson",
    "MultiBernoulli",
    "PoissonMultiBernoulli",
    "PoissonProcess",
    "SetCalibration",
    "SetNll",
    "SumPoisson",
    "UniformPoisson",
    "conformal_factor",
    "conformal_scores",
    "fit_existence",
    "fit_scale",
    "fit_set_calibration",
    "objects_from_boxes",
    "pmb_from_detections",
    "poisson_log_prob",
    "set_nll",
    "sum_associations",
]
