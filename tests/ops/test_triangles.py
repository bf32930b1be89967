import torch

from npa_envs.ops.pictures.triangles import nearest_triangles


def brute_force(place, nearness, colours, faces, seen, width, height):
    """Return the expected pictures: for each pixel, weights of corners that give its middle."""
    picture = torch.zeros(len(place), height, width, 4, dtype=torch.float64)
    for camera in range(len(place)):
        nearest = torch.zeros(height, width, dtype=torch.float64)
        for face, corners in enumerate(faces.long()):
            if not seen[camera, face]:
                continue
            system = torch.ones(3, 3, dtype=torch.float64)
            system[:2] = place[camera, corners].T
            for row in range(height):
                for column in range(width):
                    middle = torch.tensor([column + 0.5, row + 0.5, 1.0], dtype=torch.float64)
                    share = torch.linalg.solve(system, middle)
                    if share.min() < 0.0:
                        continue
                    share = share * nearness[camera, corners]
                    if share.sum() > nearest[row, column]:
                        nearest[row, column] = share.sum()
                        picture[camera, row, column, :3] = share @ colours[face] / share.sum()
                        picture[camera, row, column, 3] = 1.0
    return picture


def random_triangles(width, height):
    """Return five cameras' random triangles, some partly or wholly beside the picture."""
    generator = torch.Generator().manual_seed(1)

    def drawn(*shape):
        return torch.rand(*shape, generator=generator, dtype=torch.float64)

    place = torch.tensor([width, height]) * (2.0 * drawn(5, 18, 2) - 0.5)
    # One is far larger than the picture, two lie far from it.
    place[:, :3] = torch.tensor([[-1e12, -1e12], [1e12, -1e12], [0.0, 1e12]])
    place[:, 3:6] += 1e12
    place[:, 6:9] -= 1e12
    nearness = 0.1 + drawn(5, 18)
    nearness[:, :3] = 0.01
    seen = torch.ones(5, 6, dtype=torch.bool)
    seen[1, 5] = False
    faces = torch.arange(18).view(6, 3)
    return place, nearness, drawn(6, 3, 3), faces, seen


def test_each_pixel_shows_the_nearest_triangle():
    width, height = 11, 7
    arguments = random_triangles(width, height)
    results = nearest_triangles(*arguments, width=width, height=height)
    expected = brute_force(*arguments, width, height)
    assert len(results[..., :3].flatten(0, 2).unique(dim=0)) > 50
    torch.testing.assert_close(results, expected, rtol=1e-6, atol=1e-6)
    # Turned round, a triangle looks the same.
    place, nearness, colours, faces, seen = arguments
    again = nearest_triangles(
        place, nearness, colours.flip(1), faces.flip(1), seen, width=width, height=height
    )
    torch.testing.assert_close(again, results, rtol=1e-9, atol=1e-9)


def test_triangles_without_area_and_cameras_that_see_none_leave_pictures_empty():
    place, nearness, colours, faces, seen = random_triangles(4, 4)
    for flat, visible in ((place[:, :1].expand_as(place), seen), (place, seen & False)):
        results = nearest_triangles(flat, nearness, colours, faces, visible, width=4, height=4)
        assert not results.any()
