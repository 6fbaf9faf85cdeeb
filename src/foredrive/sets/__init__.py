"""Random finite sets: a detector's word as a density over sets of objects, and how likely the truth is."""

from foredrive.sets.associations import AssociationSum, sum_associations
from foredrive.sets.boxes import BoxDensity, LabelledBoxes
from foredrive.sets.likelihood import SetNll, set_nll
from foredrive.sets.processes import (
    MixturePoisson,
    MultiBernoulli,
    PoissonMultiBernoulli,
    PoissonProcess,
    UniformPoisson,
    poisson_log_prob,
)

__all__ = [
    "AssociationSum",
    "BoxDensity",
    "LabelledBoxes",
    "MixturePoisson",
    "MultiBernoulli",
    "PoissonMultiBernoulli",
    "PoissonProcess",
    "SetNll",
    "UniformPoisson",
    "poisson_log_prob",
    "set_nll",
    "sum_associations",
]
