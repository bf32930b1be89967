"""Sums over groups of channels, in vector registers of the CPU where its compiler finds none."""

import functools
from typing import Any

import warp as wp

from npa_envs.kernels.domain import scalar_name

_ADD_SCALED = """
#if defined(__CUDA_ARCH__)
    return total + factor * value;
#else
    typedef {part} channels __attribute__((vector_size(sizeof(total))));
    channels sum, product;
    __builtin_memcpy(&sum, &total, sizeof(total));
    __builtin_memcpy(&product, &value, sizeof(value));
    product *= factor;
    sum += product;
    auto result = total;
    __builtin_memcpy(&result, &sum, sizeof(result));
    return result;
#endif
"""


@functools.cache
def make_add_scaled(group: type, scalar: type) -> Any:
    """Return a Warp function for total + factor * value, rounded after each operation on the CPU.

    Args:
        group: A vector type, of 4, 8 or 16 channels.
        scalar: The scalar type that it is made of.
    """
    part = {"f32": "float", "f64": "double"}[scalar_name(scalar)]

    @wp.func_native(_ADD_SCALED.format(part=part))
    def add_scaled(total: group, factor: scalar, value: group) -> group: ...

    return add_scaled


@wp.func
def of_groups(thread: wp.int32, group_count: wp.int32):
    """Return the particle and the group of a thread, where adjacent ones have adjacent groups."""
    particle = wp.int32(wp.uint32(thread) / wp.uint32(group_count))
    return particle, thread - particle * group_count
