"""The rule: a small network that every particle applies to its perception vector."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from typing import Any, ParamSpec, get_args, get_type_hints

import torch
from torch import Tensor, nn
from torch.nn.modules.module import _has_any_global_hook

from npa_envs.checks import (
    MomentInverse,
    check_positive,
    checked_choice,
    checked_flag,
    checked_number,
    checked_positive,
    constant,
    is_whole,
)
from npa_envs.errors import NPAError, UnknownKeywordError, shown, suggest
from npa_envs.ops.equivariance import MIXED_VECTORS, VectorSizes, invariants, signed_gates, steered
from npa_envs.ops.physics import Terms
from npa_envs.rule.folded_network import (
    FOLD,
    FoldedInvariants,
    FoldedRule,
    Network,
    fold_weights,
    without_small,
)
from npa_envs.rule.picture_codes import Codes, checked_names, replace_code

COLOUR_OFFSET = 0.5
"""Added to a particle's last three outputs to get its colour, dimensionless."""

INIT_GAIN = 0.1
"""Gain of the Xavier-uniform initialisation: an untrained rule hardly moves its particles."""

MAX_DIM = 65536
"""Largest dimension of a rule."""

LIFE = 0
"""Index of the state that is 1 for living and 0 for dead particles, in rules that divide."""

FIRST_FATES = (5.0, -8.0)
"""Initial log odds of division, and of death, against the event that neither happens."""

STEP_PARTS = frozenset([
    "__call__", "__getattr__", "__getattribute__", "_call_impl", "_folded", "_folded_invariants",
    "_with_code_zeros", "division_probabilities", "folded", "forward", "input_dim", "network",
    "network_weights", "output_dim", "perception_dim", "update_dim", "update_weight", "vector_form",
])  # fmt: skip
"""Attributes that a step uses: a subclass that overrides one of them is not plain."""


P = ParamSpec("P")


def _naming_keywords(initialise: Callable[P, None]) -> Callable[P, None]:
    """Return an `__init__` whose error about an unknown keyword names the nearest one."""

    @functools.wraps(initialise)
    def checked(*args: P.args, **keywords: P.kwargs) -> None:
        for name in sorted(keywords.keys() - HYPER_PARAMETERS.keys()):
            hint = suggest(name, HYPER_PARAMETERS)
            raise UnknownKeywordError(f"got an unexpected keyword argument {name!r}: {hint}")
        initialise(*args, **keywords)

    return checked


class NPARule(nn.Module):
    """The update rule of Neural Particle Automata: y = W2 relu(W1 z + b1).

    z is a particle's perception vector and y = [δ (D) ; Δs (C)] its update (no δ if `static`).
    Source: arXiv 2601.16096, section 3; the same network for every particle and every step.

    An equivariant rule commutes with rotations: rotated worlds stay rotated. It mixes the gradients
    that it perceives, u = mixing^T v, and its network reads the states and the scalar products of
    pairs of mixed vectors u_a. In place of δ it outputs a number g_a for each of them, its gate,
    and δ = Σ relu(g_a) steering_a u_a, as rules of the authors' web demo do. Without `chiral` it
    commutes with reflections too. With it, a rule of 2D worlds also reads u_a × u_b, and has gates
    for the vectors rotated by 90 degrees.

    Args:
        space_dim: Space dimension D, 2 or 3.
        state_dim: State channels C.
        hidden_dim: Width of the hidden layer.
        eps0: Perception radius at which the rule is trained [length units]; perception at another
            radius is scaled to it.
        alpha: Largest displacement in one step as a fraction of the perception radius.

    Perception:
        state_gradient: The rule perceives the state gradient.
        density_gradient: The rule perceives the density gradient.
        moment_correction: The perceived state gradient is corrected by the moment matrix.
        moment_inverse: How the moment matrix is inverted for the correction: "threshold", the
            paper's, or "smooth", as in `npa_envs.perceive`.
        species_count: Species whose densities and density gradients the rule also perceives
            separately, as `npa_envs.rollout_species` runs it; 0: it does not distinguish species.

    Outputs:
        static: Particles never move: the rule has no displacement outputs.
        dead_zone: Entries y of an update with |y| <= `dead_zone` are set to 0 (dimensionless), so
            that worlds that hardly change come to rest (`at_rest`).
        readout_dim: Outputs of the read-out network s -> outputs; 0 for none.
        readout_hidden_dim: Width of the read-out's hidden layer; needed where `readout_dim` > 0.
        divides: Particles divide and die, with probabilities that depend on their states. Their
            first state is 1 for living and 0 for dead particles (`npa_envs.world.division`).

    Equivariance:
        equivariant: The rule is rotation-equivariant.
        chiral: An equivariant rule of 2D worlds distinguishes left from right.
        mixed_vectors: Number of mixed vectors of an equivariant rule, at least 1.

    Codes:
        code_dim: Length of a code, which names what to grow: the first `code_dim` state channels,
            which the rule perceives and never changes.
        code_names: Names of the known codes, at least one if `code_dim` > 0.
        encoder: A network computes codes from pictures (`codes.encode`).

    Raises:
        NPAError: A dimension or a length is out of range, `moment_inverse` or a keyword is unknown,
            or arguments exclude each other.
    """

    @_naming_keywords
    def __init__(
        self,
        space_dim: int = 2,
        state_dim: int = 16,
        hidden_dim: int = 128,
        *,
        eps0: float = 0.1,
        alpha: float = 0.5,
        static: bool = False,
        readout_dim: int = 0,
        readout_hidden_dim: int = 0,
        moment_correction: bool = True,
        state_gradient: bool = True,
        density_gradient: bool = True,
        species_count: int = 0,
        moment_inverse: MomentInverse = "threshold",
        equivariant: bool = False,
        chiral: bool = False,
        mixed_vectors: int = MIXED_VECTORS,
        code_dim: int = 0,
        code_names: Sequence[str] = (),
        encoder: bool = False,
        divides: bool = False,
        dead_zone: float = 0.0,
    ) -> None:
        super().__init__()
        self.space_dim, self.state_dim, self.hidden_dim = space_dim, state_dim, hidden_dim
        self.readout_dim, self.readout_hidden_dim = readout_dim, readout_hidden_dim
        self.species_count, self.mixed_vectors = species_count, mixed_vectors
        self.code_dim = code_dim
        self._check_sizes()
        self.eps0 = checked_positive("eps0", eps0, " [length units]")
        self.alpha = checked_positive("alpha", alpha)
        self.moment_inverse = checked_choice(
            "moment_inverse", moment_inverse, get_args(MomentInverse)
        )
        self.dead_zone = checked_number("dead_zone", dead_zone)
        self.code_names = checked_names(code_names)
        self.static = checked_flag("static", static)
        self.moment_correction = checked_flag("moment_correction", moment_correction)
        self.state_gradient = checked_flag("state_gradient", state_gradient)
        self.density_gradient = checked_flag("density_gradient", density_gradient)
        self.equivariant = checked_flag("equivariant", equivariant)
        self.chiral = checked_flag("chiral", chiral)
        self.encoder = checked_flag("encoder", encoder)
        self.divides = checked_flag("divides", divides)
        self._check_combinations()
        self._make_layers()
        self.codes = Codes(code_names, code_dim, encoder=encoder) if code_dim else None
        """The known codes, or None without `code_dim`."""

    def extra_repr(self) -> str:
        """Return what `print` shows before the layers."""
        return f"state_dim={self.state_dim}, eps0={self.eps0:g}, alpha={self.alpha:g}"

    def _make_layers(self) -> None:
        self.hidden = nn.Linear(self.input_dim, self.hidden_dim)
        self.output = nn.Linear(self.hidden_dim, self.output_dim, bias=False)
        self.readout: nn.Sequential | None = None
        if self.readout_dim:
            self.readout = nn.Sequential(
                nn.Linear(self.state_dim, self.readout_hidden_dim),
                nn.ReLU(),
                nn.Linear(self.readout_hidden_dim, self.readout_dim),
            )
        for module in self.modules():
            if isinstance(module, nn.Linear):
                nn.init.xavier_uniform_(module.weight, gain=INIT_GAIN)
        if self.divides:
            self.fate = nn.Linear(self.state_dim, 2)
            with torch.no_grad():
                self.fate.weight.zero_()
                self.fate.bias.copy_(torch.tensor(FIRST_FATES))
        if self.equivariant:
            vectors = self.vector_form
            mixing = torch.empty(vectors.perceived, vectors.mixed)
            self.mixing = nn.Parameter(nn.init.xavier_uniform_(mixing))
            steering = torch.empty(1, 0 if self.static else vectors.gate_count)
            self.steering = nn.Parameter(nn.init.xavier_uniform_(steering)[0])

    def _check_sizes(self) -> None:
        if not is_whole(self.space_dim) or self.space_dim not in (2, 3):
            raise NPAError(f"space_dim must be 2 or 3, got {shown(self.space_dim)}: try 2")
        check_positive(self, int, "state_dim", "hidden_dim", "mixed_vectors", at_most=MAX_DIM)
        others = ("readout_dim", "readout_hidden_dim", "species_count", "code_dim")
        check_positive(self, int, *others, at_least=0, at_most=MAX_DIM)
        if self.readout_dim > 0 and self.readout_hidden_dim < 1:
            raise NPAError(
                "a read-out needs readout_hidden_dim of at least 1, got "
                f"{self.readout_hidden_dim} with readout_dim={self.readout_dim}"
            )

    def _check_combinations(self) -> None:
        zone, species_count, code_dim = self.dead_zone, self.species_count, self.code_dim
        name_count, encoder = len(self.code_names), self.encoder
        if not 0.0 <= zone < math.inf:
            raise NPAError(
                "dead_zone must be a finite number of at least 0 (dimensionless), got "
                f"{shown(zone)}: try 0.001"
            )
        if self.equivariant and (zone or species_count or code_dim):
            raise NPAError(
                "an equivariant rule has no dead zone, whose edges would be directions, perceives "
                "all species alike, and has no codes, got equivariant=True with dead_zone="
                f"{shown(zone)}, species_count={species_count} and code_dim={code_dim}: leave "
                "these out"
            )
        if self.chiral and not (self.equivariant and self.space_dim == 2):
            raise NPAError(
                "chiral needs equivariant=True and space_dim=2, where vectors can be turned by 90 "
                f"degrees, got equivariant={self.equivariant} and space_dim={self.space_dim}: "
                "leave it out"
            )
        if self.equivariant and not (self.state_gradient or self.density_gradient):
            raise NPAError(
                "an equivariant rule needs vectors to perceive, got state_gradient=False and "
                "density_gradient=False: leave one of them out"
            )
        if code_dim >= self.state_dim:
            raise NPAError(
                f"code_dim must be at least 0 and below state_dim = {self.state_dim}, got "
                f"{code_dim}: a code is among the state channels"
            )
        if (code_dim > 0) != (name_count > 0) or (encoder and not code_dim):
            raise NPAError(
                "code_dim and code_names go together, and an encoder needs both, got code_dim="
                f"{code_dim}, {name_count} code_names, encoder={encoder}: for example "
                "code_dim=8, code_names=['gecko', 'heart']"
            )
        if self.divides and (self.static or species_count or code_dim):
            raise NPAError(
                "rules that divide move their particles, of one species and without codes, got "
                f"static={self.static}, species_count={species_count} and code_dim={code_dim}: "
                "leave these out"
            )

    def share(self, rule: NPARule) -> None:
        """Take another rule's settings and parameters, not copied; in place of `__init__`."""
        vars(self).update(vars(rule))

    @property
    def terms(self) -> Terms:
        """Which gradients the rule perceives, and how the moment matrix corrects one of them."""
        inverse = self.moment_inverse if self.moment_correction else None
        return Terms(self.state_gradient, inverse, self.density_gradient)

    @property
    def vector_form(self) -> VectorSizes:
        """Numbers of scalars and vectors that an equivariant rule perceives, and of mixed vectors.

        Mixed vectors are linear combinations of the perceived ones.
        """
        vectors = self.state_dim * self.state_gradient + self.density_gradient
        return VectorSizes(
            self.space_dim, 2 * self.state_dim, vectors, self.mixed_vectors, self.chiral
        )

    @property
    def input_dim(self) -> int:
        """Number of the hidden layer's inputs: P.

        Those of an equivariant rule are perceived scalars and products of mixed vectors.
        """
        return self.vector_form.input_dim if self.equivariant else self.perception_dim

    @property
    def output_dim(self) -> int:
        """Number of the second layer's outputs: A - code_dim.

        Those of an equivariant rule are gates, the factors of mixed vectors in δ, and Δs.
        """
        if not self.equivariant or self.static:
            return self.update_dim - self.code_dim
        return self.vector_form.gate_count + self.state_dim

    @property
    def perception_dim(self) -> int:
        """Length P of the perception vector: C(2+D)+D, and 1+D for each distinguished species."""
        shared = self.terms.perception_dim(self.space_dim, self.state_dim)
        return shared + self.species_count * (1 + self.space_dim)

    @property
    def update_dim(self) -> int:
        """Length A of the update: D+C, or C if static."""
        return self.state_dim + (0 if self.static else self.space_dim)

    @property
    def weight_count(self) -> int:
        """Number of parameters."""
        return sum(parameter.numel() for parameter in self.parameters())

    def forward(self, perception: Tensor) -> Tensor:
        """Map perception vectors to updates, each by itself.

        Args:
            perception: Perception vectors z, dimensionless, shape [..., P].

        Returns:
            Updates [δ (D) ; Δs (C)], dimensionless, shape [..., A]; δ is not yet bounded.
        """
        output: Tensor
        if self.equivariant:
            mixed, inputs = invariants(perception, self.mixing, self.vector_form)
            output = self.output(torch.relu(self.hidden(inputs)))
            return (
                output if self.static else steered(output, mixed, self.steering, self.vector_form)
            )
        output = self.output(torch.relu(self.hidden(perception)))
        return self._with_code_zeros(without_small(output, self.dead_zone), dim=-1)

    @property
    def update_weight(self) -> Tensor:
        """W2 [A, H]: the second layer's weight, with rows of zeros where the code is."""
        return self._with_code_zeros(self.output.weight, dim=0)

    def _with_code_zeros(self, outputs: Tensor, *, dim: int) -> Tensor:
        """Return updates or weights with zeros for the code inserted after δ in dimension `dim`."""
        if self.code_dim == 0:
            return outputs
        moves, states = outputs.tensor_split([self.update_dim - self.state_dim], dim=dim)
        shape = list(states.shape)
        shape[dim] = self.code_dim
        return torch.cat((moves, states.new_zeros(shape), states), dim=dim)

    def is_plain(self) -> bool:
        """Return whether the rule computes nothing but its two layers, as `folded` does.

        It does more if it is equivariant, if there are hooks, or if the subclass or the object
        overrides an attribute of `STEP_PARTS`, a layer, or a layer's `forward`.
        """
        return not self.equivariant and self.has_network()

    def has_network(self) -> bool:
        """Return whether no subclass, hook or layer alters what `NPARule` computes."""
        cls, attributes = type(self), self.__dict__
        # Each rollout comes here; torch.compile traces no set operation.
        if cls is NPARule and not torch.compiler.is_compiling():
            if not STEP_PARTS.isdisjoint(attributes):
                return False
        else:
            for name in STEP_PARTS:
                if name in attributes or getattr(cls, name) is not getattr(NPARule, name):
                    return False
        # `_modules` is faster than attributes of modules.
        layers: Any = self._modules
        for name in ("hidden", "output", "fate") if self.divides else ("hidden", "output"):
            layer = layers.get(name)
            if type(layer) is not nn.Linear or is_altered(layer, backward=True):
                return False
        return (
            layers["hidden"]._parameters.get("bias") is not None
            and layers["output"]._parameters.get("bias") is None
            and not is_altered(self, backward=True)
            and not _has_any_global_hook()  # type: ignore[no-untyped-call]
        )

    def network(self) -> Network | None:
        """Return the network as matrix products on padded perception vectors, for steps.

        None: a subclass, hook or layer changes the network, so a step calls `forward`.
        """
        if self.is_plain():
            return self.folded()
        return self._folded_invariants() if self.has_network() else None

    def _folded_invariants(self) -> FoldedInvariants:
        """Return an equivariant rule's network for steps; differentiable in the parameters."""
        width = self.perception_dim + 1
        weight, signs = signed_gates(self.output.weight, self.steering)
        return FoldedInvariants(
            self._folded(weight),
            self.mixing,
            signs,
            self.vector_form,
            row_width=width + -width % FOLD,
            update_width=self.update_dim + -self.update_dim % FOLD,
        )

    def network_weights(self) -> list[Tensor]:
        """Return the parameters that a step uses, without those of the read-out."""
        # These are faster than attributes of modules: public calls read the weights.
        layers: Any = self._modules
        hidden, output = layers["hidden"]._parameters, layers["output"]._parameters
        weights = [hidden["weight"], hidden["bias"], output["weight"]]
        weights += [self.mixing, self.steering] if self.equivariant else []
        return weights + ([self.fate.weight, self.fate.bias] if self.divides else [])

    def folded(self) -> FoldedRule:
        """Return a plain rule's network for steps, with its bias in the first matrix.

        It is differentiable in the parameters.
        """
        return self._folded(self.update_weight)

    def _folded(self, update_weight: Tensor) -> FoldedRule:
        padding = -(self.input_dim + 1) % FOLD
        weight = torch.cat((self.hidden.weight, self.hidden.bias[:, None]), dim=1)
        output_weight = nn.functional.pad(update_weight, (0, 0, 0, -len(update_weight) % FOLD))
        hidden_weight = nn.functional.pad(weight, (0, padding))
        return fold_weights(hidden_weight, output_weight, constant(self.dead_zone))

    def division_probabilities(self, states: Tensor) -> tuple[Tensor, Tensor]:
        """Return the probabilities that updated particles divide and die, shape [...] each.

        For states [..., C] they are the softmax of (a, 0, b), where (a, b) = W s + c and 0 is for
        neither. The rule must divide.
        """
        dividing, dying = self.fate(states).unbind(dim=-1)
        odds = torch.stack((dividing, torch.zeros_like(dividing), dying), dim=-1)
        divide, _, die = odds.softmax(dim=-1).unbind(dim=-1)
        return divide, die

    def read_out(self, states: Tensor) -> Tensor:
        """Return the outputs of the read-out for states [..., C]; without one, the states."""
        if self.readout is None:
            return states
        outputs: Tensor = self.readout(states)
        return outputs

    def colour(self, states: Tensor) -> Tensor:
        """Return RGB colours of states [..., C]: the last three outputs, unclipped, [..., 3].

        Raises:
            NPAError: There are fewer than three outputs.
        """
        outputs = self.read_out(states)
        if outputs.shape[-1] < 3:
            cure = "make the rule with state_dim=3 or more"
            if states.shape[-1] < self.state_dim:
                cure = f"give all {self.state_dim} channels"
            raise NPAError(
                f"colours are the last three outputs of a particle, got {outputs.shape[-1]}: {cure}"
            )
        return outputs[..., -3:] + COLOUR_OFFSET

    def with_code(self, states: Tensor, code: Tensor) -> Tensor:
        """Return states whose first channels are replaced by a code.

        Args:
            states: Particle states, dimensionless, shape [B, N, C].
            code: A code, dimensionless, shape [code_dim]; one for each world, [B, 1, code_dim]; or
                one for each particle, [B, N, code_dim].

        Raises:
            NPAError: The rule has no codes, the code is no tensor, or the shapes do not fit.
        """
        if self.code_dim == 0:
            raise NPAError("this rule has no codes: train one with targets (--targets)")
        if not isinstance(code, Tensor):
            raise NPAError(
                f"code must be a tensor, got {shown(code)}: for example rule.codes[name], or "
                "torch.tensor(numbers)"
            )
        shape = (*states.shape[:-1], self.code_dim)
        try:
            return replace_code(states, code.expand(shape))
        except RuntimeError as error:
            raise NPAError(
                "code must have shape [code_dim], [B, 1, code_dim] or [B, N, code_dim] for "
                f"{shape}, got {tuple(code.shape)}"
            ) from error

    def hyper_parameters(self) -> dict[str, Any]:
        """Return the arguments of `NPARule` that make an untrained rule like this one."""
        return {name: getattr(self, name) for name in HYPER_PARAMETERS}


HYPER_PARAMETERS = {k: v for k, v in get_type_hints(NPARule.__init__).items() if k != "return"}
"""Arguments of `NPARule`: name -> type."""


def is_altered(module: nn.Module, *, backward: bool = False) -> bool:
    """Return whether a module has its own `forward`, or hooks; with `backward`, also those."""
    own = module.__dict__
    if backward and (own["_backward_hooks"] or own["_backward_pre_hooks"]):
        return True
    return bool("forward" in own or own["_forward_hooks"] or own["_forward_pre_hooks"])


@torch.no_grad()
def enlarged(rule: NPARule, untrained: NPARule) -> NPARule:
    """Copy the weights of a rule without codes into an untrained, larger one, and return that.

    The columns of the code and additional hidden units keep their untrained weights. Where the
    shapes do not fit, nothing is copied and `rule` is returned.
    """
    count, space_dim, code_dim = untrained.state_dim, untrained.space_dim, untrained.code_dim
    shared = torch.ones(untrained.perception_dim, dtype=torch.bool)
    shared[:code_dim] = False
    shared[count : count + code_dim] = False
    if untrained.state_gradient:
        shared[2 * count : 2 * count + code_dim * space_dim] = False
    rows = rule.hidden_dim
    fits = (
        int(shared.sum()) == rule.perception_dim
        and rows <= untrained.hidden_dim
        and rule.output_dim == untrained.output_dim
        and rule.readout is None
        and untrained.readout is None
    )
    if not fits:
        return rule
    untrained.hidden.weight[:rows, shared] = rule.hidden.weight.to(untrained.hidden.weight)
    untrained.hidden.bias[:rows] = rule.hidden.bias.to(untrained.hidden.bias)
    untrained.output.weight[:, :rows] = rule.output.weight.to(untrained.output.weight)
    return untrained


def with_division(rule: NPARule) -> NPARule:
    """Return a copy of a rule whose particles also divide and die, by an untrained layer."""
    copied = NPARule(**rule.hyper_parameters() | {"divides": True}).to(rule.hidden.weight)
    copied.load_state_dict(copied.state_dict() | rule.state_dict())
    return copied


def fate_parameters(rules: nn.Module) -> list[nn.Parameter]:
    """Return the parameters of all layers `fate`, which decide division and death, in a module."""
    every = (module for module in rules.modules() if isinstance(module, NPARule))
    return [parameter for rule in every if rule.divides for parameter in rule.fate.parameters()]


def check_rule(rule: Any) -> None:
    """Raise NPAError unless an object is a rule, or one that `torch.compile` has wrapped."""
    if not isinstance(rule, NPARule) and not isinstance(getattr(rule, "_orig_mod", None), NPARule):
        raise NPAError(
            f"rule must be an NPARule, got {type(rule).__name__}: subclass npa_envs.NPARule "
            "(docs/own_rule.md), or load one with npa_envs.load_rule"
        )
