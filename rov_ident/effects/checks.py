"""Whether an effect that was written elsewhere (docs/own-effects.md) keeps the rules of `base`."""

import re
from collections.abc import Mapping
from typing import Any, get_args

import numpy as np

from rov_ident.core.errors import UserError
from rov_ident.effects.base import (
    MEMORY,
    SIZE,
    STEER_MEMORY,
    Effect,
    EffectParameter,
    Place,
    a_reading,
)
from rov_ident.model.coefficients import INPUTS, parse
from rov_ident.model.equations import RigidBody

_HOOKS = ("coefficients", "body", "wrench", "water", "act", "steer", "sense", "late", "heading")


def faults(effect: Any) -> str:
    """What is wrong with an effect that was written elsewhere, in words; empty if nothing is."""
    if not isinstance(effect, Effect):
        return "is no rov_ident.effects.base.Effect"
    if effect.place not in get_args(Place):
        return f"must have one of {', '.join(get_args(Place))} as its place"
    if sum(bool(getattr(effect, hook)) for hook in _HOOKS) != 1:
        return f"must have exactly one of {', '.join(_HOOKS)}"
    if bool(effect.sense) != bool(effect.correct):
        return "must have sense and correct, or neither"
    if not isinstance(effect.parameters, tuple) or not all(
        isinstance(p, EffectParameter) for p in effect.parameters
    ):
        return "must have a tuple of EffectParameter as its parameters"
    if len(effect.parameters) > SIZE:
        return f"has {len(effect.parameters)} parameters, but may have {SIZE} at most"
    if bool(effect.parameters) == bool(effect.coefficients):
        return "must have parameters, or coefficients"
    if len({p.name for p in effect.parameters}) < len(effect.parameters):
        return "must have a name of its own for each parameter"
    for p in effect.parameters:
        if not re.fullmatch(r"[A-Za-z]\w*", p.name, re.ASCII):
            return f"needs letters, digits and underscores as the name of its parameter {p.name!r}"
        if not (p.lower <= p.null <= p.upper and p.typical > 0.0):
            return f"needs lower <= null <= upper and typical > 0 of its parameter {p.name}"
    try:
        for name in effect.coefficients:
            parse(name)
    except UserError as error:
        return f"has a coefficient that is none: {error}"
    return _fault_of_hooks(effect)


def _fault_of_hooks(effect: Effect) -> str:
    """What goes wrong when the hooks are called at the nulls, where they must do nothing, and at
    the typical sizes; empty if nothing.

    Kernels are called as the Python functions they are: compiled, an index beyond the end of an
    array would read and write other numbers, and nobody would be told.
    """
    nulls = {p.name: p.null for p in effect.parameters}
    typical = {p.name: min(p.null + p.typical, p.upper) for p in effect.parameters}
    return _fault_at(effect, nulls, True) or _fault_at(effect, typical, False)


def _fault_at(effect: Effect, values: Mapping[str, float], is_null: bool) -> str:
    p, six, three, eye = np.zeros(SIZE), np.full(6, 0.1), np.ones(3), np.eye(3)
    p[: len(values)] = list(values.values())
    for given in (p, six, three, eye):
        given.flags.writeable = False  # no hook may change them: others read them, too
    body = RigidBody(1.0, 10.0, 10.0, np.zeros(3), np.zeros(3), np.eye(3))
    kernels: dict[str, tuple[Any, ...]] = {
        "wrench": (p, 1.0, three, six, eye, six, six.copy()),
        "act": (p, np.zeros(MEMORY), 1.0, 0.1, six.copy()),
        "steer": (p, np.zeros(STEER_MEMORY), 0.1, np.full((2, len(INPUTS)), 0.1)),
    }
    functions: dict[str, tuple[tuple[Any, ...], tuple[int, ...] | None]] = {
        "body": ((body,), None),
        "water": ((), (3,)),
        "late": ((), ()),
        "heading": ((), ()),
        "noise": ((), (6,)),
        "sense": ((a_reading(),), (4, 3)),
        "correct": ((a_reading(),), (4, 3)),
    }
    name = ""
    try:
        with np.errstate(all="ignore"):
            for name, arguments in kernels.items():
                if (hook := getattr(effect, name)) is not None:
                    if not hasattr(hook, "py_func"):
                        return f"must have a kernel as its {name} (rov_ident.core.jit.kernel)"
                    before = arguments[-1].copy()
                    hook.py_func(*arguments)
                    if not np.isfinite(arguments[-1]).all():
                        return f"gives numbers that are not finite from its {name}"
                    if is_null and not np.allclose(arguments[-1], before):
                        return f"must do nothing at its nulls, but its {name} does"
            for name, (arguments, shape) in functions.items():
                if (hook := getattr(effect, name)) is not None:
                    found = hook(*arguments, **values)
                    if arguments and not isinstance(found, type(arguments[0])):
                        return f"must return a {type(arguments[0]).__name__} from its {name}"
                    if shape is not None and np.shape(found) != shape:
                        return f"must return numbers of the shape {shape} from its {name}"
                    same = arguments[0] if shape == (4, 3) else 0.0
                    if is_null and shape is not None and not np.allclose(found, same):
                        return f"must do nothing at its nulls, but its {name} does"
            name = "of_thrusters"
            shapes = [] if effect.of_thrusters is None else effect.of_thrusters(np.eye(6))
            if not all(set(shape) <= set(values) for shape in shapes):
                return f"must return only parameters of its own from its {name}"
    except Exception as error:  # it is code of others
        return f"fails in its {name} ({type(error).__name__}: {error})"
    return ""
