"""Log-densities of many boxes under many densities, without gradients. `boxes` has the reference version."""

import math
from typing import no_type_check

import numba
import numpy as np

_kernel = numba.njit(cache=True, nogil=True, error_model="numpy")
_LOG_2PI = math.log(2 * math.pi)
_SQRT_2 = math.sqrt(2)
_NEGLIGIBLE_NATS = 40.0


@_kernel
@no_type_check
def box_log_prob(mean, chol, state, laplace):
    """Return the log-densities without heading: mean [M D], chol [M D D], state [N D] → [M N].

    It solves L w = state - mean by forward substitution, with boxes in the innermost loops for vectorisation.
    """
    components, dims = mean.shape
    boxes = len(state)
    by_dim = np.ascontiguousarray(state.T)
    log_prob, white = np.empty((components, boxes)), np.empty((dims, boxes))
    for i in range(components):
        out = log_prob[i]
        constant = 0.0
        for d in range(dims):
            # log of the constant: Σ log L_dd, and ½ log 2π (or ½ log 2) for each dimension
            constant -= np.log(chol[i, d, d]) + (0.5 * math.log(2) if laplace else 0.5 * _LOG_2PI)
        out[:] = constant
        for d in range(dims):
            offset, scale, row = mean[i, d], 1.0 / chol[i, d, d], white[d]
            coordinate = by_dim[d]
            for j in range(boxes):
                # w[d] = (offset[d] - Σ_e<d L[d, e] w[e]) / L[d, d]
                row[j] = coordinate[j] - offset
            for e in range(d):
                factor, other = chol[i, d, e], white[e]
                if factor != 0.0:
                    for j in range(boxes):
                        row[j] -= factor * other[j]
            for j in range(boxes):
                row[j] *= scale
            if laplace:
                for j in range(boxes):
                    out[j] -= _SQRT_2 * abs(row[j])
            else:
                for j in range(boxes):
                    out[j] -= 0.5 * row[j] * row[j]
    return log_prob


@_kernel
@no_type_check
def add_heading(log_prob, mean_yaw, concentration, log_i0e, yaw):
    """Add the von Mises log-densities of the headings to `log_prob` [M N] in place.

    The shapes are mean_yaw, concentration, log_i0e [M] and yaw [N].
    """
    # κ cos(yaw - mean) by the addition theorem: one product per box instead of a cosine
    cos, sin = np.cos(yaw), np.sin(yaw)
    for i in range(len(mean_yaw)):
        out, kappa = log_prob[i], concentration[i]
        along, across = kappa * np.cos(mean_yaw[i]), kappa * np.sin(mean_yaw[i])
        constant = kappa + log_i0e[i] + _LOG_2PI
        for j in range(len(yaw)):
            out[j] += along * cos[j] + across * sin[j] - constant


@_kernel
@no_type_check
def log_sum_exp(log_terms):
    """Return the log-sum-exp over the rows: [M N] → [N]. Terms 40 nats below the largest are skipped."""
    total = np.empty(log_terms.shape[1])
    top = np.full(log_terms.shape[1], -np.inf)
    for row in log_terms:
        for j in range(len(top)):
            # Largest term of each column first, then the sum relative to it
            top[j] = max(top[j], row[j])
    total[:] = 0.0
    for row in log_terms:
        for j in range(len(top)):
            if row[j] > top[j] - _NEGLIGIBLE_NATS:
                total[j] += np.exp(row[j] - top[j])
    return top + np.log(total)
