import math

import numpy as np
import pytest
import torch

from npa_envs.ops import splat
from npa_envs.render import STYLES, draw_worlds, to_uint8
from npa_envs.render.colours import (
    RAMP_LENGTH,
    RAMP_STOPS,
    density_colours,
    oklab,
    ramp,
    srgb,
    state_colours,
)

RED = (0.5, -0.5, -0.5)
BLUE = (-0.5, -0.5, 0.5)
VIEW = {"resolution": 32, "pixel_size": 0.1}


def random_worlds(space_dim: int = 2, world_count: int = 3) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(7)
    x = torch.rand(world_count, 70, space_dim, generator=generator) * 1.6 - 0.8
    s = torch.rand(world_count, 70, 8, generator=generator) * 2.4 - 1.2
    return x, s


def middle(picture: np.ndarray) -> np.ndarray:
    side = picture.shape[1] // 2
    return picture[:, side - 1 : side + 1, side - 1 : side + 1].mean(axis=(1, 2))


def test_particles_look_as_the_splat_of_their_clipped_colours():
    x, s = random_worlds()
    colour = (s[..., -3:] + 0.5).clamp(0, 1)
    expected = to_uint8(splat(x, colour, resolution=32, pixel_size=0.1, sigma=0.7), "navy")
    trained = x.clone().requires_grad_()
    drawn = draw_worlds(trained, s, sigma=0.7, background="navy", **VIEW)
    np.testing.assert_array_equal(drawn, expected)
    assert torch.equal(trained, x)
    assert expected.std() > 20


@pytest.mark.parametrize("style", STYLES)
def test_a_periodic_picture_has_no_seam(style):
    x, s = random_worlds()
    view = {"style": style, "half_width": 0.8, "periodic": True, **VIEW}
    picture = draw_worlds(x, s, **view)
    moved = draw_worlds(x + 0.4, s, **view)
    # By a quarter of the side to the right and up; rounding may change a last bit.
    rolled = np.roll(picture, (-8, 8), axis=(1, 2)).astype(int)
    assert np.abs(moved - rolled).max() <= 1
    assert np.abs(moved.astype(int) - picture).max() > 50
    x[0, 0], x[0, 1] = math.nan, 1e9
    hidden, left = draw_worlds(x, s, **view), draw_worlds(x[:, 2:], s[:, 2:], **view)
    np.testing.assert_array_equal(hidden[0], left[0])


@pytest.mark.parametrize("style", STYLES)
@pytest.mark.parametrize("space_dim", [2, 3])
def test_a_world_looks_the_same_alone_and_in_a_batch(style, space_dim):
    x, s = random_worlds(space_dim)
    together = draw_worlds(x, s, style=style, azimuth=40.0, **VIEW)
    assert together.shape == (3, 32, 32, 3)
    assert together.dtype == np.uint8
    for k in range(3):
        alone = draw_worlds(x[k : k + 1], s[k : k + 1], style=style, azimuth=40.0, **VIEW)
        np.testing.assert_array_equal(alone[0], together[k])
    assert (together[0] != together[1]).any()


@pytest.mark.parametrize("style", STYLES)
@pytest.mark.parametrize("space_dim", [2, 3])
@pytest.mark.parametrize("background", ["white", "black", "#102030"])
def test_where_no_particle_is_there_is_background(style, space_dim, background):
    x, s = random_worlds(space_dim)
    picture = draw_worlds(x * 0.1 - 0.5, s, style=style, background=background, **VIEW)
    corner = to_uint8(torch.zeros(1, 1, 4), background)[0, 0]
    assert (picture[:, :4, -4:] == corner).all()
    assert (picture != corner).any()


@pytest.mark.parametrize("style", STYLES)
@pytest.mark.parametrize("space_dim", [2, 3])
def test_particles_that_are_not_finite_are_left_out(style, space_dim):
    x, s = random_worlds(space_dim)
    broken = x.clone()
    broken[0, ::3, 0] = float("nan")
    broken[1, ::3, -1] = float("inf")
    broken[2, ::3, 0] = -1e38
    whole = [k for k in range(70) if k % 3]
    seen = draw_worlds(broken, s, style=style, **VIEW)
    expected = draw_worlds(x[:, whole], s[:, whole], style=style, **VIEW).astype(int)
    # The layers of 3D colours are cut elsewhere where particles are missing.
    layered = space_dim == 3 and style != "density"
    assert np.abs(seen - expected).mean() <= (1.0 if layered else 0.0)
    assert np.abs(draw_worlds(x, s, style=style, **VIEW) - expected).mean() > 1.0
    nothing = draw_worlds(x * float("nan"), s, style=style, **VIEW)
    assert (nothing == 255).all()


@pytest.mark.parametrize("style", ["particles", "states"])
def test_particles_of_states_that_are_not_finite_are_left_out_where_states_show(style):
    x, s = random_worlds()
    whole = [k for k in range(70) if k % 3 != 1]
    expected = draw_worlds(x[:, whole], s[:, whole], style=style, **VIEW)
    for value in (float("inf"), float("nan")):
        s[:, 1::3, -1] = value
        np.testing.assert_array_equal(draw_worlds(x, s, style=style, **VIEW), expected)
    density = draw_worlds(x, s, style="density", **VIEW)
    finite = draw_worlds(x, s.nan_to_num(), style="density", **VIEW)
    np.testing.assert_array_equal(density, finite)


def test_centre_is_what_lies_in_the_middle_and_half_width_zooms():
    x, s = random_worlds()
    shift = torch.tensor([[0.25, -0.5], [1.0, 0.5], [-2.0, 0.0]])
    grid = (x * 1024).round() / 1024
    expected = draw_worlds(grid, s, **VIEW)
    for moved, view in (
        (grid + shift[:, None], {"centre": shift, **VIEW}),
        (grid + shift[0], {"centre": (0.25, -0.5), **VIEW}),
        (4 * grid, {"resolution": 32, "pixel_size": 0.4, "half_width": 4.0}),
    ):
        np.testing.assert_array_equal(draw_worlds(moved, s, **view), expected)


@pytest.mark.parametrize("style", STYLES)
@pytest.mark.parametrize("z", [(), (0.3,)])
def test_y_points_up_and_x_to_the_right(style, z):
    x = torch.tensor([[[0.5, 0.75, *z]]])
    s = torch.tensor([[RED]])
    picture = draw_worlds(x, s, style=style, resolution=33, pixel_size=0.1, elevation=0.0)[0]
    row, column = np.unravel_index(picture[..., 1].argmin(), (33, 33))
    assert (row, column) == (4, 24)


def test_density_one_is_the_middle_of_the_ramp_and_crowding_its_end():
    axis = torch.arange(-1.5, 1.5, 0.1)
    x = torch.cartesian_prod(axis, axis)[None]
    s = torch.zeros(1, x.shape[1], 2)
    once = middle(draw_worlds(x, s, style="density", pixel_size=0.1))[0]
    table = ramp((1.0, 1.0, 1.0)).astype(int)
    assert np.abs(once - table[RAMP_LENGTH // 2]).max() <= 2
    crowd = x.repeat(1, 12, 1)
    crowded = middle(draw_worlds(crowd, s.repeat(1, 12, 1), style="density", **VIEW))[0]
    assert np.abs(crowded - table[-1]).max() <= 1
    darkest = [int(RAMP_STOPS[0][k : k + 2], 16) for k in (1, 3, 5)]
    assert table[-1].tolist() == darkest
    shown = density_colours(torch.tensor([0.0, 0.5, 1.0, 2.0, 1e30]), (1.0, 1.0, 1.0))
    assert (oklab(torch.from_numpy(shown / 255))[:, 0].diff() < -0.05).all()


def test_states_do_not_show_the_colour_channels_and_need_no_others():
    x, s = random_worlds()
    recoloured = torch.cat((s[..., :-3], -s[..., -3:]), dim=-1)
    expected = draw_worlds(x, s, style="states", **VIEW)
    np.testing.assert_array_equal(draw_worlds(x, recoloured, style="states", **VIEW), expected)
    assert (draw_worlds(x, -s, style="states", **VIEW) != expected).any()
    for state_dim in (1, 2, 3):
        plain = draw_worlds(x, s[..., :state_dim], style="states", **VIEW)
        assert np.ptp(plain.astype(int), axis=-1).max() <= 1
        assert plain.min() < 200
    one = draw_worlds(x, s[..., -4:], style="states", **VIEW)
    assert np.ptp(one.astype(int), axis=-1).max() > 20


@pytest.mark.parametrize(
    ("axis", "azimuth", "elevation", "front"),
    [(2, 0.0, 0.0, 0), (2, 180.0, 0.0, 2), (0, 90.0, 0.0, 0), (1, 0.0, 90.0, 0)],
    ids=["in front", "behind", "from the right", "from above"],
)
def test_what_is_near_to_the_camera_covers_what_is_far(axis, azimuth, elevation, front):
    ends = torch.zeros(1, 2, 3)
    ends[0, :, axis] = torch.tensor([0.5, -0.5])
    view = {"azimuth": azimuth, "elevation": elevation, **VIEW}
    seen = middle(draw_worlds(ends, torch.tensor([[RED, BLUE]]), **view))[0]
    assert seen[front] > seen[2 - front] + 60


def test_from_above_what_is_near_to_the_viewer_is_low_in_the_picture():
    near = torch.tensor([[[0.0, 0.0, 0.6]]])
    picture = draw_worlds(near, torch.tensor([[RED]]), elevation=45.0, azimuth=0.0, **VIEW)[0]
    darkness = 255.0 - picture[..., 1].astype(float)
    assert darkness[16:].sum() > 0.99 * darkness.sum() > 0.0


@pytest.mark.parametrize("style", STYLES)
def test_a_full_turn_changes_nothing(style):
    x, s = random_worlds(3)
    start = draw_worlds(x, s, style=style, **VIEW)
    for angle in (360.0, -720.0, 3.6e15):
        np.testing.assert_array_equal(draw_worlds(x, s, style=style, azimuth=angle, **VIEW), start)
    assert (draw_worlds(x, s, style=style, azimuth=90.0, **VIEW) != start).any()


def test_far_particles_are_darker():
    depths = torch.tensor([0.9, -0.9])[:, None, None] * torch.tensor([0.0, 0.0, 1.0])
    pictures = draw_worlds(
        depths, torch.full((2, 1, 3), 0.5), elevation=0, background="black", **VIEW
    )
    near, far = pictures.max(axis=(1, 2, 3))
    assert 60 < far < 0.7 * near


@pytest.mark.gpu
@pytest.mark.parametrize("style", STYLES)
@pytest.mark.parametrize("space_dim", [2, 3])
def test_pictures_of_a_gpu_are_repeatable_and_those_of_the_cpu(style, space_dim):
    x, s = random_worlds(space_dim)
    there = draw_worlds(x.cuda(), s.cuda(), style=style, azimuth=40.0, **VIEW)
    again = draw_worlds(x.cuda(), s.cuda(), style=style, azimuth=40.0, **VIEW)
    np.testing.assert_array_equal(there, again)
    here = draw_worlds(x, s, style=style, azimuth=40.0, **VIEW).astype(int)
    assert np.abs(there - here).max() <= 2


# Colours.


@pytest.mark.parametrize(("background", "sign"), [((1.0, 1.0, 1.0), -1), ((0.0, 0.0, 0.0), 1)])
def test_the_ramp_is_even_to_the_eye(background, sign):
    table = ramp(background)
    steps = np.diff(oklab(torch.from_numpy(table[::32] / 255)).numpy(), axis=0)
    # Of the darkest colours, 8 bits hold too few to be even.
    lengths = np.linalg.norm(steps, axis=1)[table[:-32:32].max(axis=1) > 40]
    assert len(lengths) > 20
    assert lengths.max() / lengths.min() < 1.35
    assert (sign * steps[:, 0] >= 0).all()
    assert (table[0] == np.array(background) * 255).all()


def test_oklab_has_its_published_values_and_an_inverse():
    rgb = torch.tensor([[1.0, 1.0, 1.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
    published = torch.tensor(
        [[1.0, 0.0, 0.0], [0.628, 0.2249, 0.1258], [0.452, -0.0325, -0.3115]], dtype=torch.float64
    )
    torch.testing.assert_close(oklab(rgb), published, rtol=0, atol=1e-3)
    colours = torch.rand(50, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(srgb(oklab(colours)), colours, rtol=0, atol=1e-5)


def test_blank_states_are_grey_and_states_differ_in_bounded_colours():
    grey = state_colours(torch.zeros(1, 13))[0]
    assert (grey.max() - grey.min()) < 1e-3
    assert 0.4 < grey.mean() < 0.8
    channels = oklab(state_colours(torch.eye(13) * 0.8))
    apart = torch.cdist(channels, channels) + torch.eye(13)
    assert apart.min() > 0.02
    assert (channels - oklab(grey)).norm(dim=1).min() > 0.05
    generator = torch.Generator().manual_seed(1)
    for size in (1.0, 1e4, 1e30):
        colours = state_colours(torch.randn(200, 13, generator=generator) * size)
        assert ((colours >= 0) & (colours <= 1)).all()
