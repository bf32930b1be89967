"""`make golden-check` sees a changed bit, and its scenes can still be made."""

import check
import numpy as np
import wide

LEFT = {
    "a/x": np.array([1.0, np.nan, 0.0], np.float32),
    "a/words": np.array(["cut", "clump"]),
    "a/ends": np.array([True, False]),
}


def changed(name, array):
    return [said[0] for said in check.compare(LEFT | {name: array}, LEFT)]


def test_equal_arrays_are_equal_also_where_they_are_no_numbers():
    assert check.compare({name: array.copy() for name, array in LEFT.items()}, LEFT) == []


def test_one_changed_bit_is_seen():
    assert changed("a/x", np.nextafter(LEFT["a/x"], np.float32(9))) == ["a/x"]
    assert changed("a/x", np.array([1.0, np.nan, -0.0], np.float32)) == ["a/x"]
    assert changed("a/x", LEFT["a/x"].astype(np.float64)) == ["a/x"]
    assert changed("a/x", LEFT["a/x"][:2]) == ["a/x"]
    assert changed("a/words", np.array(["cut", "push"])) == ["a/words"]
    assert changed("a/ends", ~LEFT["a/ends"]) == ["a/ends"]


def test_arrays_of_one_side_and_scenes_that_fail_are_seen():
    assert changed("a/y", LEFT["a/x"]) == ["a/y"]
    assert [said[0] for said in check.compare({}, LEFT)] == sorted(LEFT)
    failed = {"b/EXCEPTION": np.asarray("ValueError: no")}
    assert [said[0] for said in check.compare(LEFT | failed, LEFT | failed)] == ["b/EXCEPTION"]


def test_scenes_and_the_names_that_they_take_from_the_library_are_there():
    scenes = wide.scenes()
    first = {name.split("/")[0] for name in scenes}
    assert {"rule", "kind", "env", "batch", "species", "train", "learn", "evaluate"} <= first
    found = {}
    wide.flat(scenes["brushes"](), "brushes", found)
    assert len(found) > 15
    assert all(np.isfinite(array).all() for array in found.values())
