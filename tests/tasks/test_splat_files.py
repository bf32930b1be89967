"""Point clouds and trained Gaussians as 3D targets, compared with scenes that are known."""

import math

import numpy as np
import pytest
import torch
from support import reference_gaussians

from npa_envs.errors import NPAError
from npa_envs.render.point_files import write_gaussians
from npa_envs.tasks.gaussian_outputs import Gaussians
from npa_envs.tasks.targets import views
from npa_envs.tasks.targets.meshes import RADIUS, load_mesh
from npa_envs.tasks.targets.splat_files import colours_from, ply_kind, read_splats
from npa_envs.tasks.targets.views import composited, draw_mesh, load_views


def write_ply(path, columns, *, faces=0):
    """Write a PLY file of rows with these columns, by name; its types are those of the arrays."""
    types = {"u1": "uchar", "f4": "float", "u2": "ushort", "f8": "double"}
    table = np.rec.fromarrays(list(columns.values()), names=list(columns))
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {len(table)}"]
    lines += [f"property {types[v.dtype.str[1:]]} {name}" for name, v in columns.items()]
    lines += [f"element face {faces}", "property list uchar int vertex_indices", "end_header\n"]
    triangles = b"".join(bytes([3, *np.int32((0, 1, 2)).tobytes()]) for _ in range(faces))
    path.write_bytes("\n".join(lines).encode() + table.tobytes() + triangles)
    return path


def points_on(mesh, count):
    """Return points spread evenly over a mesh, and their colours, [count, 3] each."""
    random, corners = np.random.default_rng(0), mesh.vertices[mesh.faces]
    sides = corners[:, 1:] - corners[:, :1]
    area = np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1)
    face = random.choice(len(area), count, p=area / area.sum())
    share = random.dirichlet((1.0, 1.0, 1.0), count)[..., None]
    return [(share * values[face]).sum(axis=1) for values in (corners, mesh.colours)]


def psnr(pictures, expected):
    """Return the mean PSNR of views on white [dB]."""
    white = torch.ones(3)
    error = composited(pictures, white).clamp(0, 1) - composited(expected, white)
    return float((-10 * error.square().mean(dim=(1, 2, 3)).log10()).mean())


@pytest.mark.parametrize(
    ("kind", "names", "least"),
    [
        # Seen: 29.3 dB.
        (np.uint8, ("red", "green", "blue"), 27.0),
        (np.float32, ("red", "green", "blue"), 27.0),
        (np.uint16, ("diffuse_red", "diffuse_green", "diffuse_blue"), 27.0),
    ],
)
def test_views_of_a_point_cloud_are_those_of_its_surface(tmp_path, monkeypatch, kind, names, least):
    pytest.importorskip("scipy")
    mesh = load_mesh("mushroom")
    places, colours = points_on(mesh, 20_000)
    # Elsewhere, larger, with a stray.
    places = np.concatenate((40.0 * places + (3.0, -90.0, 7.0), [(9e4, 0.0, 0.0)]))
    colours = np.concatenate((colours, [(0.0, 1.0, 0.0)]))
    stored = colours if kind is np.float32 else (np.iinfo(kind).max * colours).round()
    columns = dict(zip("xyz", places.T.astype(np.float32), strict=True))
    columns |= dict(zip(names, stored.T.astype(kind), strict=True))
    path = write_ply(tmp_path / "cloud.ply", columns)
    target = load_views(path, resolution=96, training_count=1, held_out_count=4)
    assert target.summary == "cloud.ply: 20001 points"
    # Points have the colours that they are seen in, without a light.
    monkeypatch.setattr(views, "AMBIENT", 1.0)
    expected = torch.from_numpy(draw_mesh(mesh, target.held_out.cameras))
    assert psnr(target.held_out.pictures, expected) > least
    colours, alpha = target.held_out.pictures.split((3, 1), dim=-1)
    assert bool((colours <= alpha).all())


def random_gaussians(degree, count=60):
    """Return columns of a 3DGS file, and the same as means, scales, quaternions ... [N, any]."""
    random = np.random.default_rng(degree)
    means = random.uniform(-1.0, 1.0, (count, 3))
    means[:2] = (-1.0, -1.0, -1.0), (1.0, 1.0, 1.0)
    logs, logits = random.uniform(-2.6, -1.6, (count, 3)), random.uniform(-1.0, 4.0, count)
    quaternions = random.normal(size=(count, 4))
    # Small: pictures have no colours above 1.
    harmonics = 0.3 / (degree + 1) * random.normal(size=(count, (degree + 1) ** 2, 3))
    rest = harmonics[:, 1:].swapaxes(1, 2).reshape(count, -1)
    columns = dict(zip("xyz", means.T, strict=True)) | {"opacity": logits}
    columns |= {f"f_rest_{k}": rest[:, k] for k in range(rest.shape[1])}
    columns |= {f"f_dc_{k}": harmonics[:, 0, k] for k in range(3)}
    columns |= {f"scale_{k}": logs[:, k] for k in range(3)}
    columns |= {f"rot_{k}": quaternions[:, k] for k in range(4)}
    columns = {name: values.astype(np.float32) for name, values in columns.items()}
    opacities = 1.0 / (1.0 + np.exp(-logits))
    return columns, (means, np.exp(logs), quaternions, opacities, harmonics)


def real_harmonics(degree, directions):
    """Return real spherical harmonics with the Condon-Shortley phase, [N, (degree + 1)²]."""
    special = pytest.importorskip("scipy.special")
    unit = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    theta, phi = np.arccos(unit[:, 2]), np.arctan2(unit[:, 1], unit[:, 0])
    rows = []
    for ell in range(degree + 1):
        for m in range(-ell, ell + 1):
            value = special.sph_harm_y(ell, abs(m), theta, phi) * (math.sqrt(2) if m else 1.0)
            rows.append(value.imag if m < 0 else value.real)
    return np.stack(rows, axis=1)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_views_of_trained_gaussians_are_those_of_the_formulas(tmp_path, degree):
    """Every Gaussian at every sample, with colours by scipy's spherical harmonics."""
    columns, (means, scales, quaternions, opacities, harmonics) = random_gaussians(degree)
    path = write_ply(tmp_path / "trained.ply", columns)
    target = load_views(path, resolution=32, training_count=1, held_out_count=3)
    assert target.summary == f"trained.ply: 60 Gaussians, spherical harmonics of degree {degree}"
    size = RADIUS / math.sqrt(3.0)
    cameras, expected = target.held_out.cameras, []
    for motion in cameras.world_to_camera.double():
        eye = -(motion[:3, :3].T @ motion[:3, 3]).numpy()
        basis = real_harmonics(degree, size * means - eye)
        colours = (np.einsum("nk,nkc->nc", basis, harmonics) + 0.5).clip(0.0)
        picture, passing = reference_gaussians.draw(
            *(torch.from_numpy(v) for v in (size * means, size * scales, quaternions, opacities)),
            torch.from_numpy(colours),
            view=motion,
            intrinsics=4.0 * cameras.intrinsics.double(),
            width=128,
            height=128,
            near=0.01,
        )
        whole = torch.cat((picture, 1.0 - passing[..., None]), dim=-1)
        expected.append(whole.view(32, 4, 32, 4, 4).mean(dim=(1, 3)))
    # Seen: 145 dB; without degree 3 it is 40.
    assert psnr(target.held_out.pictures, torch.stack(expected).float()) > 80.0


def test_harmonics_are_those_of_the_library_s_own_files(tmp_path):
    """A world written as Gaussians is read again as it was."""
    generator = torch.Generator().manual_seed(0)

    def drawn(*shape):
        return torch.rand(1, 50, *shape, generator=generator)

    x, gaussians = 2 * drawn(3) - 1, Gaussians(drawn(3), drawn(4), drawn(), drawn(4, 3), drawn(3))
    write_gaussians(tmp_path / "world.ply", x, gaussians)
    splats = read_splats(tmp_path / "world.ply")
    size = splats.scales[0, 0] / gaussians.scales[0, 0, 0]
    torch.testing.assert_close(splats.scales, size * gaussians.scales[0])
    torch.testing.assert_close(splats.opacities, gaussians.opacities[0])
    torch.testing.assert_close(splats.harmonics, gaussians.colours[0])
    middle = 0.5 * (x[0].amax(dim=0) + x[0].amin(dim=0))
    torch.testing.assert_close(splats.means, size * (x[0] - middle), atol=1e-6, rtol=1e-5)
    assert float(splats.means.norm(dim=1).max()) == pytest.approx(RADIUS)
    ahead = torch.tensor([[0.0, 0.0, 2.0]]).expand(50, 3)
    alike = reference_gaussians.directed_colours(splats.harmonics, ahead / 2.0)
    torch.testing.assert_close(colours_from(splats.harmonics, ahead), alike)


def columns_of(count=40, **others):
    places = np.random.default_rng(0).random((3, count)).astype(np.float32)
    return dict(zip("xyz", places, strict=True)) | others


def test_the_header_decides_what_a_ply_file_is(tmp_path):
    trained, _ = random_gaussians(0)
    cases = [(columns_of(), 1, "triangles"), (columns_of(), 0, "points"), (trained, 0, "gaussians")]
    for columns, faces, kind in cases:
        assert ply_kind(write_ply(tmp_path / "file.ply", columns, faces=faces)) == kind
    path = write_ply(tmp_path / "file.ply", columns_of(), faces=0)
    comment = b"comment element tristrips 9 \nelement"
    path.write_bytes(path.read_bytes().replace(b"element", comment, 1))
    assert ply_kind(path) == "points"
    (tmp_path / "file.ply").write_bytes(b"ply\nelement vertex 3\n")
    assert ply_kind(tmp_path / "file.ply") == "triangles"


def test_what_clouds_lack_is_told(tmp_path, caplog):
    pytest.importorskip("scipy")
    columns = columns_of()
    columns["x"][:2], columns["x"][5] = np.nan, columns["x"][4]
    for name in "yz":
        columns[name][5] = columns[name][4]
    target = load_views(
        write_ply(tmp_path / "grey.ply", columns), resolution=8, training_count=1, held_out_count=1
    )
    assert target.summary == "grey.ply: 37 points"
    assert caplog.messages == [
        "grey.ply: left out: colours, as the file has none: all is grey",
        "grey.ply: left out: 2 points without a place",
        "grey.ply: left out: 1 point at the place of another",
    ]


def without(name):
    columns, _ = random_gaussians(1)
    del columns[name]
    return columns


REFUSED = [
    (without("rot_3"), "must have the properties .* rot_3 is missing"),
    (without("f_rest_8"), "must have 0, 9, 24 or 45 properties f_rest_0, .* got 8"),
    (columns_of(packed_position=np.ones(40, np.float32)), "is compressed .packed_position"),
    (columns_of(8), "must hold at least 9 points apart, got 8"),
    (without("opacity") | {"opacity": np.full(60, -9, np.float32)}, "opacity of at least 0.1"),
]


@pytest.mark.parametrize(("columns", "message"), REFUSED)
def test_files_that_are_not_whole_are_refused_by_name(tmp_path, columns, message):
    pytest.importorskip("scipy")
    path = write_ply(tmp_path / "file.ply", columns)
    with pytest.raises(NPAError, match=message):
        load_views(path, resolution=8)
    path.write_bytes(path.read_bytes()[:-8])
    with pytest.raises(NPAError, match="cannot be read as points or Gaussians"):
        load_views(path, resolution=8)
