"""Attention within sets: beside a mask over all tokens, the kernel beside its reference."""

import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from foredrive.ops.set_attention import attend_within, attend_within_reference

SIZES = st.lists(st.integers(1, 150), min_size=1, max_size=12)


def case(
    seed: int, sizes: list[int], heads: int, width: int, spread: float = 1.0
) -> tuple[Tensor, Tensor, Tensor, Tensor, int]:
    generator = torch.Generator().manual_seed(seed)
    count = sum(sizes)
    query_key = spread * torch.randn(count, 2 * heads * width, generator=generator)
    value = torch.randn(count, heads * width, generator=generator)
    return query_key, value, torch.randperm(count, generator=generator), torch.tensor(sizes), heads


def dense(query_key: Tensor, value: Tensor, order: Tensor, counts: Tensor, heads: int) -> Tensor:
    """The same with a mask over all pairs of tokens."""
    number = torch.empty_like(order)
    number[order] = torch.arange(len(counts)).repeat_interleave(counts)
    query, key, value = (
        part.unflatten(1, (heads, -1)).transpose(0, 1) for part in (*query_key.chunk(2, -1), value)
    )
    fit = (query @ key.mT / query.shape[-1] ** 0.5).masked_fill(number[:, None] != number, -torch.inf)
    return (fit.softmax(-1) @ value).transpose(0, 1).flatten(1)


@given(st.integers(0, 1000), SIZES, st.integers(1, 3))
@settings(max_examples=25, deadline=None)
def test_the_kernel_gives_what_a_mask_over_all_gives(seed: int, sizes: list[int], heads: int) -> None:
    given_case = case(seed, sizes, heads, 16)
    torch.testing.assert_close(attend_within(*given_case), dense(*given_case), atol=2e-6, rtol=1e-5)


@given(st.integers(0, 1000), SIZES, st.sampled_from([(1, 4), (2, 8), (2, 16)]))
@settings(max_examples=15, deadline=None)
def test_the_reference_gives_what_a_mask_over_all_gives(
    seed: int, sizes: list[int], heads_of: tuple[int, int]
) -> None:
    given_case = case(seed, sizes, *heads_of)
    torch.testing.assert_close(attend_within_reference(*given_case), dense(*given_case), atol=2e-6, rtol=1e-5)


def test_fits_far_apart_stay_finite() -> None:
    given_case = case(0, [40, 3], 1, 16, spread=40.0)
    found = attend_within(*given_case)
    assert found.isfinite().all()
    torch.testing.assert_close(found, dense(*given_case), atol=1e-4, rtol=1e-3)


def test_gradients_are_those_of_a_mask_over_all() -> None:
    query_key, value, *sets = case(1, [20, 1, 9], 2, 16)
    leaves = [query_key.requires_grad_(), value.requires_grad_()]
    weights = torch.randn_like(value)
    found = torch.autograd.grad((attend_within(query_key, value, *sets) * weights).sum(), leaves)
    expected = torch.autograd.grad((dense(query_key, value, *sets) * weights).sum(), leaves)
    for a, b in zip(found, expected, strict=True):
        torch.testing.assert_close(a, b, atol=1e-5, rtol=1e-4)
