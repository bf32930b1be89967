"""Spiky factors of pairs in float64 for positions in float32: density gradients cancel."""

import functools

import warp as wp

from npa_envs.kernels.domain import domain_types
from npa_envs.kernels.slots import inverse_root


@functools.cache
def make_spiky_wide(space_dim: int, periodic: bool) -> wp.Function:
    """Return the function of one variant.

    Args:
        space_dim: Space dimension D.
        periodic: Whether space is a periodic box.
    """
    scalar = wp.float32
    types = domain_types(space_dim, scalar)
    vector, Domain = types.vector, types.Domain
    wide = wp.types.vector(space_dim, wp.float64)

    @wp.func
    def spiky_wide(domain: Domain, centre: vector, neighbour: vector, squared: scalar):
        """Spiky factor and distance vector of a pair in float64, as in `perception`."""
        r = wide()
        start = squared
        for d in range(wp.static(space_dim)):
            r[d] = wp.float64(neighbour[d]) - wp.float64(centre[d])
        if wp.static(periodic):
            for d in range(wp.static(space_dim)):
                images = wp.round((neighbour[d] - centre[d]) * domain.inverse_box[d])
                r[d] -= wp.float64(images) * wp.float64(domain.box[d])
            start = scalar(wp.dot(r, r))
        exact = wp.dot(r, r)
        apart = wp.where(start > scalar(0.0), inverse_root(start), scalar(0.0))
        inverse = wp.float64(apart)
        inverse *= wp.float64(1.5) - wp.float64(0.5) * exact * inverse * inverse
        falloff = wp.float64(1.0) - exact * inverse * wp.float64(domain.inverse_eps)
        return wp.float64(domain.spiky_norm) * falloff * falloff * inverse, r

    return spiky_wide
