"""Conversion of models to and from python-control and scipy.signal."""

from __future__ import annotations

import importlib
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import matrix_balance, null_space

from haselab.base import InputError
from haselab.models.rational import RationalModel

__all__ = ["from_control", "from_scipy", "to_control", "to_scipy"]

Floats = NDArray[np.float64]
_ROUNDING = 1e-11
_FORMS = ("tf", "ss", "zpk")


def to_scipy(model: RationalModel, form: str = "tf", *, delay_order: int = 0) -> Any:
    """Convert a model to scipy.signal, which does not support delays.

    Args:
        model: the model.
        form: "tf" TransferFunction, "ss" StateSpace or "zpk" ZerosPolesGain.
        delay_order: order of the all-pass that replaces a delay; required if there is a delay.
    Returns:
        A system in continuous time.
    Raises:
        InputError: an unknown form, or a delay without an order for it.
    Example:
        >>> system = to_scipy(RationalModel((2.0,), (1.0, 3.0)), "zpk")
        >>> system.poles.real.tolist(), float(system.gain)
        ([-3.0], 2.0)
    """
    rational = _delay_free(model, delay_order, "scipy.signal")
    if form not in _FORMS:
        raise InputError(f"form = {form}; it must be one of {', '.join(_FORMS)}.")
    from scipy import signal  # the import takes half a second

    if form == "ss":
        return signal.StateSpace(*_state_space(rational))
    if form == "zpk":
        return signal.ZerosPolesGain(rational.zeros, rational.poles, rational.numerator[0])
    return signal.TransferFunction(rational.numerator, rational.denominator)


def from_scipy(system: Any) -> RationalModel:
    """Convert a model from scipy.signal.

    Args:
        system: TransferFunction, StateSpace or ZerosPolesGain in continuous time.
    Returns:
        The model; its zeros and relative degree are those of the system, not artefacts of rounding.
    Raises:
        InputError: another object, discrete time, several inputs or outputs.
    """
    from scipy import signal

    if isinstance(system, signal.StateSpace):
        return _from_state_space(system.A, system.B, system.C, system.D, system.dt)
    if not isinstance(system, (signal.TransferFunction, signal.ZerosPolesGain)):
        raise InputError(
            f"The model is a {type(system).__name__}; it must be TransferFunction, StateSpace or "
            "ZerosPolesGain of scipy.signal. Convert it."
        )
    _check_continuous(system.dt)
    ratio = system.to_tf()
    return _rational(ratio.num, ratio.den)


def to_control(model: RationalModel, form: str = "tf", *, delay_order: int = 0) -> Any:
    """Convert a model to python-control, which does not support delays.

    Args:
        model: the model.
        form: "tf" TransferFunction or "ss" StateSpace.
        delay_order: order of the all-pass that replaces a delay; required if there is a delay.
    Returns:
        A system in continuous time with the names of input and output.
    Raises:
        InputError: python-control is not installed, an unknown form, or a delay and no order.
    """
    if form not in _FORMS[:2]:
        raise InputError(f"form = {form}; it must be one of {', '.join(_FORMS[:2])}.")
    try:
        control = importlib.import_module("control")
    except ImportError as error:
        raise InputError(
            "This needs python-control 0.10 or later, which is not installed. "
            "Run: pip install 'haselab[control]'"
        ) from error
    rational = _delay_free(model, delay_order, "python-control")
    names = {"inputs": model.input_name, "outputs": model.output_name}
    if form == "tf":
        return control.TransferFunction(rational.numerator, rational.denominator, **names)
    return control.StateSpace(*_state_space(rational), **names)


def from_control(system: Any) -> RationalModel:
    """Convert a model from python-control.

    Args:
        system: TransferFunction or StateSpace in continuous time.
    Returns:
        The model with the names of its input and output.
    Raises:
        InputError: another object, discrete time, several inputs or outputs.
    """
    labels = (_label(system, "input_labels", "u"), _label(system, "output_labels", "y"))
    if all(hasattr(system, name) for name in ("A", "B", "C", "D")):
        return _from_state_space(system.A, system.B, system.C, system.D, system.dt, labels)
    if not all(hasattr(system, name) for name in ("num", "den", "dt")):
        raise InputError(
            f"The model is a {type(system).__name__}; it must be TransferFunction or StateSpace "
            "of python-control. Convert it."
        )
    _check_continuous(system.dt)
    if len(system.num) != 1 or len(system.num[0]) != 1:
        raise _many(len(system.num[0]), len(system.num))
    return _rational(system.num[0][0], system.den[0][0], labels)


def _delay_free(model: RationalModel, delay_order: int, tool: str) -> RationalModel:
    if model.delay_s > 0.0 and delay_order == 0:
        raise InputError(
            f"The model has a delay of {model.delay_s:g} s, which {tool} cannot represent. Give "
            "delay_order = 1 to 10, the order of an all-pass, or remove the delay "
            "with without_delay(0)."
        )
    return model.without_delay(delay_order)


def _state_space(model: RationalModel) -> tuple[Floats, Floats, Floats, Floats]:
    """Balanced companion form."""
    order = len(model.denominator) - 1
    top = np.zeros(order + 1)
    top[order + 1 - len(model.numerator) :] = model.numerator
    bottom = np.array(model.denominator)
    companion, first = np.eye(order, k=-1), np.eye(order, 1)
    if order:
        companion[0] = -bottom[1:]
    balanced, scale = matrix_balance(companion, permute=False)
    row = (top[1:] - top[0] * bottom[1:])[None, :]
    return balanced, np.linalg.inv(scale) @ first, row @ scale, np.array([[top[0]]])


def _from_state_space(
    a: Any, b: Any, c: Any, d: Any, step_s: Any, labels: tuple[str, str] = ("u", "y")
) -> RationalModel:
    _check_continuous(step_s)
    matrices = [np.atleast_2d(np.asarray(matrix, dtype=np.float64)) for matrix in (a, b, c, d)]
    outputs, inputs = matrices[3].shape
    if (outputs, inputs) != (1, 1):
        raise _many(inputs, outputs)
    balanced, scale = matrix_balance(matrices[0], permute=False)
    before, after = np.linalg.inv(scale) @ matrices[1], matrices[2] @ scale
    numerator = _numerator(balanced, before, after, float(matrices[3][0, 0]))
    return _rational(numerator, np.real(np.poly(balanced)), labels)


def _numerator(a: Floats, b: Floats, c: Floats, through: float) -> Floats:
    """Leading factor times the polynomial of the zeros.

    The leading factor is the first Markov parameter that is not zero; the zeros are the poles of
    the zero dynamics.
    """
    if through != 0.0:
        return np.asarray(through * np.real(np.poly(a - b @ c / through)))
    rows, lead = c, 0.0
    for _ in range(a.shape[0]):
        lead = float((rows[-1:] @ b)[0, 0])
        if abs(lead) > _ROUNDING * float(np.linalg.norm(rows[-1]) * np.linalg.norm(b)):
            break
        rows, lead = np.vstack([rows, rows[-1:] @ a]), 0.0
    if lead == 0.0:
        return np.zeros(1)
    held = null_space(rows / np.linalg.norm(rows, axis=1, keepdims=True))
    if held.shape[1] == 0:
        return np.array([lead])
    moving = held.T @ (a - b @ (rows[-1:] @ a) / lead) @ held
    return np.asarray(lead * np.real(np.poly(moving)))


def _rational(
    numerator: Any, denominator: Any, labels: tuple[str, str] = ("u", "y")
) -> RationalModel:
    top, bottom = (np.atleast_1d(np.squeeze(np.asarray(x))) for x in (numerator, denominator))
    return RationalModel(tuple(top.tolist()), tuple(bottom.tolist()), 0.0, *labels)


def _label(system: Any, attribute: str, otherwise: str) -> str:
    labels = getattr(system, attribute, None)
    return str(labels[0]) if labels else otherwise


def _check_continuous(step_s: Any) -> None:
    """python-control uses 0 for continuous time, scipy None."""
    if step_s is not None and (step_s is True or float(step_s) != 0.0):
        raise InputError(
            f"The model is in discrete time (dt = {step_s}); it must be in continuous time. "
            "Convert it, for example with d2c, or fit the records here."
        )


def _many(inputs: int, outputs: int) -> InputError:
    return InputError(
        f"The model has {inputs} inputs and {outputs} outputs; it must have one of each. Select "
        "one channel of it."
    )
