"""`npa-envs view`: serves a live world to the browser."""

from __future__ import annotations

import contextlib
import re
import sys
import webbrowser
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from npa_envs.cli import common
from npa_envs.cli.doctor import has_screen
from npa_envs.errors import NPAError

if TYPE_CHECKING:
    import torch

    from npa_envs.web.live_world import LiveWorld


@dataclass(frozen=True, kw_only=True)
class ViewOptions(common.DeviceOptions):
    """Watch and change a live world in the browser: a rule, a training run or an environment.

    The page has brushes, sliders, damage and films. A run's world follows its newest checkpoint.
    A picture, a mesh or an emoji that is dropped on the page is learned while one watches.
    The server answers only this computer; with another --host it prints a link with a token.

    Examples:
      npa-envs view gecko
      npa-envs view runs/heart
      npa-envs view npa/Morphogenesis2D-v0 --policy gecko
      npa-envs view npa/Gardener2DSmall-v0 --policy shipped
    """

    what: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="[RULE|RUN|ENV]")] = "gecko"
    """A shipped rule (`npa-envs list`), a rule's file, the folder of a run, or the id of an
    environment: npa/Texture-v0, or MODULE:my/Own-v0 for one that your module registers."""
    policy: str = "zero"
    """The policy in an environment: "zero", "random", or a rule for it. Where one controller acts,
    as in gardens: "shipped", or the file of a policy; in gardens also "scripted"."""
    keywords: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME=VALUE")] = ()
    """Keywords of the environment, for example target=dots eps=0.3 eps0=0.3."""
    particle_count: int | None = None
    """Particles N; default: as trained."""
    seed: int | None = None
    """Seed of the first world; default: 5, for `digits` 12, a digit that is easy to read."""
    threads: int = 1
    """CPU threads of torch and of the kernels; the browser needs a core as well."""
    host: str = "127.0.0.1"
    """The address to bind; with 0.0.0.0 other computers can connect with the token."""
    port: int | None = None
    """The port; default: the first free one from 8765 on."""
    browser: bool = True
    """Open the page in a browser."""
    out: Path = Path("runs/view")
    """Folder of recorded films and of runs that pages start; created where missing."""


def main(arguments: Sequence[str]) -> int:
    """Serve a live world to the browser until Ctrl-C; return 0."""
    options = common.parse_options(ViewOptions, "view", arguments)
    if not 1 <= options.threads <= 256:
        raise NPAError(f"threads must be in [1, 256], got {options.threads}")
    device = options.checked_device()
    make_world = world_maker(options, device)
    with common.torch_threads(options.threads):
        # Made once before the server starts, so that errors come at once.
        world = make_world()
        world.close()
    from npa_envs.web.environment_world import EnvironmentWorld
    from npa_envs.web.server import Site, address_of, open_port, serve
    from npa_envs.web.training_session import Training

    out = common.writable_folder(options.out)
    learns = not isinstance(world, EnvironmentWorld)
    site = Site(
        make_world, films=out, host=options.host, one_at_a_time=device.type == "cuda",
        training=Training(out, device=options.device) if learns else None,
    )  # fmt: skip
    listener = open_port(options.host, options.port)
    with contextlib.closing(listener), common.torch_threads(options.threads):
        address = address_of(site, listener)
        print(f"{options.what}: {address}  (Ctrl-C ends it)", flush=True)
        if options.browser and not open_browser(address):
            print("no browser was found here: open the link in yours", flush=True)
        serve(site, listener)
    return 0


def open_browser(address: str) -> bool:
    """Open a page in a graphical browser; return False if there is none."""
    return has_screen() and webbrowser.open(address)


def world_maker(options: ViewOptions, device: torch.device) -> Callable[[], LiveWorld]:
    """Return a function that makes a live world of the rule, run or environment `options.what`."""
    from npa_envs.web.environment_world import EnvironmentWorld, make_environment
    from npa_envs.web.rule_world import RuleWorld, RunWorld

    folder, seed = Path(options.what), options.seed
    if seed is None:
        seed = 12 if options.what == "digits" else 5
    # Ids of Gymnasium end in a version.
    if re.search(r"-v\d+$", options.what) and not folder.exists():
        policy = options.policy
        keywords = common.named_values("keywords", options.keywords)
        for name in ("id", "policy", "device", "output", "disable_env_checker"):
            if name in keywords:
                is_option = name in ("device", "policy")
                hint = f"say --{name} {keywords[name]}" if is_option else "leave it out"
                raise NPAError(
                    f"keywords must leave {name} to the command, got {name}={keywords[name]}: "
                    f"{hint}"
                )
        keywords = {"particle_count": options.particle_count} | keywords
        # Modules of the user are imported from the current folder.
        sys.path.insert(0, str(Path.cwd()))

        def make_world() -> LiveWorld:
            env, acting = make_environment(options.what, policy, device=str(device), **keywords)
            return EnvironmentWorld(env, acting, seed=seed, policy_name=policy)

        return make_world
    if options.policy != "zero" or options.keywords:
        name = "keywords" if options.keywords else "policy"
        raise NPAError(
            f"{name} is for environments, got --{name} with a rule or a run: leave it out"
        )
    common.check_has_rule(options.what)
    kwargs: Any = {"device": device, "seed": seed, "particle_count": options.particle_count}
    run_files = ("config.json", "log.jsonl", "checkpoint.pt")
    if folder.is_dir() and any((folder / name).exists() for name in run_files):
        return lambda: RunWorld(folder, **kwargs)
    return lambda: RuleWorld(options.what, **kwargs)
