"""Slope bounds of an expression over a box: interval arithmetic with branch and bound.

An upper bound of a partial derivative is found by splitting the box where its enclosure is largest, until the enclosure
meets the largest value seen at a point. The result always bounds the slope (up to rounding, which is far below the
margin of a certificate); the splits only make it tight.
"""

import heapq
import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from adapters.errors import ModelError
from gains.plants.expression import (
    Apply,
    Argument,
    Node,
    Number,
    argument_indices,
    binary,
    compile_node,
    derivative,
    is_smooth,
    parse_expression,
)

Interval = tuple[float, float]
Box = tuple[Interval, ...]

_BUDGET = 3000
"""Largest number of boxes that are split to prove one bound, within the bound on nodes below."""
# Largest number of nodes evaluated to bound one slope: a model of unknown origin must not keep its reader waiting.
_WORK = 400_000
_TIGHTNESS = 1e-5
_DECLARED_TOLERANCE = 1e-6
_LARGEST = math.nextafter(math.inf, 0.0)
_FAR = 1e9


class _UndefinedError(ArithmeticError):
    """The expression has no value, or no bound, somewhere in the box."""


@dataclass(frozen=True, slots=True)
class _Supremum:
    """Upper bound of a maximum, the largest value found, and its point."""

    bound: float
    seen: float
    point: tuple[float, ...]


def slope_bounds(text: str, arguments: Sequence[str], ranges: Sequence[Interval]) -> list[Interval]:
    """Return (a_j, b_j) with a_j <= dg/dnu_j <= b_j for each argument on the box, whose bounds may be infinite.

    Raises
    ------
    ModelError
        The expression is invalid, has no value somewhere on the box, or a slope has no bound there.
    """
    node, box = parse_expression(text, arguments), tuple(ranges)
    _check_defined(node, box, text, arguments)
    bounds = []
    for j, name in enumerate(arguments):
        slope = derivative(node, j)
        upper, lower = _supremum(slope, box).bound, -_supremum(_negative(slope), box).bound
        if not (math.isfinite(upper) and math.isfinite(lower)):
            raise ModelError(
                f"the slope of '{text}' with respect to {name} has no bound for {_box_text(arguments, box)}: "
                "give a (smaller) range for its arguments"
            )
        bounds.append((lower + 0.0, upper + 0.0))
    return bounds


def check_slopes(text: str, arguments: Sequence[str], ranges: Sequence[Interval], declared: Sequence[Interval]) -> None:
    """Prove declared slope bounds, or raise a ModelError: one is violated, or can be neither proven nor refuted."""
    node, box = parse_expression(text, arguments), tuple(ranges)
    _check_defined(node, box, text, arguments)
    for j, name in enumerate(arguments):
        slope = derivative(node, j)
        for sign, limit in ((1.0, declared[j][1]), (-1.0, declared[j][0])):
            goal = sign * limit + _DECLARED_TOLERANCE * (1.0 + abs(limit))
            supremum = _supremum(slope if sign > 0.0 else _negative(slope), box, goal)
            if supremum.seen > goal:
                at = ", ".join(f"{a} = {v:g}" for a, v in zip(arguments, supremum.point, strict=True))
                raise ModelError(
                    f"the slope of '{text}' with respect to {name} is {sign * supremum.seen:g} at {at}, "
                    f"{'above' if sign > 0.0 else 'below'} the declared {limit:g}"
                )
            if supremum.bound > goal:
                side = "below" if sign > 0.0 else "above"
                raise ModelError(
                    f"the slope of '{text}' with respect to {name} could not be proven to stay {side} "
                    f"{limit:g} for {_box_text(arguments, box)}: give a (smaller) range or a wider slope"
                )


def enclosure(node: Node, box: Box) -> Interval:
    """Return an interval that holds every value of the tree on the box.

    Raises
    ------
    ArithmeticError
        The tree has no value, or a pole, somewhere in the box.
    """
    if isinstance(node, Number):
        return node.value, node.value
    if isinstance(node, Argument):
        return box[node.index]
    if isinstance(node, Apply):
        return _tidy(*_FUNCTION_ENCLOSURES[node.function](*enclosure(node.operand, box)))
    low, high = enclosure(node.left, box)
    if node.operator == "**":
        if not isinstance(node.right, Number):
            raise TypeError("the exponent of a power is a Number")
        return _tidy(*_power(low, high, node.right.value))
    other_low, other_high = enclosure(node.right, box)
    if node.operator == "+":
        return _tidy(low + other_low, high + other_high)
    if node.operator == "-":
        return _tidy(low - other_high, high - other_low)
    if node.operator == "/":
        if other_low <= 0.0 <= other_high:
            raise _UndefinedError
        other_low, other_high = 1.0 / other_high, 1.0 / other_low
        if math.isinf(other_low) or math.isinf(other_high):
            raise _UndefinedError
    ends = [_product(x, y) for x in (low, high) for y in (other_low, other_high)]
    return _tidy(min(ends), max(ends))


def _supremum(node: Node, box: Box, goal: float | None = None) -> _Supremum:
    """Bound the maximum of the tree on the box by splitting it.

    Without a goal the bound is made tight; with one the search ends as soon as the bound is at or below the goal or a
    value above the goal was found.
    """
    function = compile_node(node)
    split = sorted(argument_indices(node))
    depends = frozenset(split)
    gradient = {i: derivative(node, i) for i in split} if is_smooth(node) else {}
    order = itertools.count()
    seen, least, point = -math.inf, math.inf, tuple(_middle(*side) for side in box)

    def look(at: tuple[float, ...]) -> None:
        nonlocal seen, least, point
        value = function(*at)
        if value > seen:
            seen, point = value, at
        least = min(least, value)

    def ranked(part: Box) -> tuple[float, int, Box]:
        sides = [
            (_middle(*side), *map(_near, side)) if i in depends else (_middle(*side),) for i, side in enumerate(part)
        ]
        for corner in itertools.product(*sides):
            look(corner)
        try:
            bound = min(enclosure(node, part)[1], _mean_value_bound(function, gradient, part))
        except ArithmeticError:
            bound = math.inf
        return -bound, next(order), part

    # Any value will do for arguments on which the tree does not depend.
    work = 3 ** len(split) * _size(node) + sum(map(_size, gradient.values()))
    if work > _WORK:
        raise ModelError("too much to bound its slope: use fewer arguments or a simpler expression")
    heap = [ranked(box)]
    for _ in range(min(_BUDGET, _WORK // work) if split else 0):
        bound = -heap[0][0]
        enough = seen + _TIGHTNESS * max(abs(seen), abs(least)) if goal is None else goal
        if bound <= enough or (goal is not None and seen > goal):
            break
        _, _, part = heapq.heappop(heap)
        widest = max(split, key=lambda i: _relative_width(part[i], box[i]))
        low, high = part[widest]
        middle = _middle(low, high)
        for half in ((low, middle), (middle, high)):
            heapq.heappush(heap, ranked((*part[:widest], half, *part[widest + 1 :])))
    return _Supremum(max(-heap[0][0], seen), seen, point)


def _mean_value_bound(function: Callable[..., float], gradient: dict[int, Node], part: Box) -> float:
    """Bound a maximum by f(m) + max |f'| |x - m|, which is closer than the enclosure on small boxes."""
    bound = function(*(_middle(*side) for side in part))
    for i, slope in gradient.items():
        half = 0.5 * (part[i][1] - part[i][0])
        bound += half * max(map(abs, enclosure(slope, part))) if half < math.inf else math.inf
    return bound if gradient and not math.isnan(bound) else math.inf


def _check_defined(node: Node, box: Box, text: str, arguments: Sequence[str]) -> None:
    """Refuse an expression that has no value somewhere on the box."""
    parts, split = [box], sorted(argument_indices(node))
    for _ in range(_BUDGET):
        if not parts:
            return
        part = parts.pop()
        try:
            enclosure(node, part)
        except ArithmeticError:
            widest = max(split, key=lambda i: _relative_width(part[i], box[i]))
            low, high = part[widest]
            middle = _middle(low, high)
            parts += [(*part[:widest], half, *part[widest + 1 :]) for half in ((low, middle), (middle, high))]
    raise ModelError(f"'{text}' has no value, or a pole, for some {_box_text(arguments, box)}: give a (smaller) range")


def _size(node: Node) -> int:
    """Return the number of nodes of a tree."""
    if isinstance(node, Apply):
        return 1 + _size(node.operand)
    if isinstance(node, Number | Argument):
        return 1
    return 1 + _size(node.left) + _size(node.right)


def _negative(node: Node) -> Node:
    return binary("*", Number(-1.0), node)


def _middle(low: float, high: float) -> float:
    """Return where to split an interval that may be infinite."""
    if math.isinf(low) and math.isinf(high):
        return 0.0
    if math.isinf(high):
        return 0.0 if low < 0.0 else max(1.0, 2.0 * low)
    if math.isinf(low):
        return 0.0 if high > 0.0 else min(-1.0, 2.0 * high)
    return 0.5 * low + 0.5 * high


def _near(value: float) -> float:
    return max(-_FAR, min(_FAR, value))


def _relative_width(side: Interval, whole: Interval) -> float:
    width, full = side[1] - side[0], whole[1] - whole[0]
    return width if math.isinf(full) else width / full


def _box_text(arguments: Sequence[str], box: Box) -> str:
    return ", ".join(f"{name} in [{low:g}, {high:g}]" for name, (low, high) in zip(arguments, box, strict=True))


def _tidy(low: float, high: float) -> Interval:
    """Return an enclosure without NaN, with a lower bound below infinity and an upper bound above minus infinity."""
    if math.isnan(low) or math.isnan(high):
        return -math.inf, math.inf
    return min(low, _LARGEST), max(high, -_LARGEST)


def _product(x: float, y: float) -> float:
    return 0.0 if x == 0.0 or y == 0.0 else x * y


def _power(low: float, high: float, exponent: float) -> Interval:
    if exponent < 0.0:
        below, above = _power(low, high, -exponent)
        if below <= 0.0 <= above or math.isinf(1.0 / below) or math.isinf(1.0 / above):
            raise _UndefinedError
        return 1.0 / above, 1.0 / below

    def power(x: float) -> float:
        return math.pow(x, exponent)

    if exponent % 2.0 == 0.0:
        return _even(low, high, 0.0, power)
    if low < 0.0 and not exponent.is_integer():
        raise _UndefinedError
    return _monotone(power, low), _monotone(power, high)


def _monotone(function: Callable[[float], float], x: float) -> float:
    """Return the value at an end of an interval, infinity if it overflows."""
    try:
        return function(x)
    except OverflowError:
        return math.copysign(math.inf, function(math.copysign(1.0, x)))


def _wave(low: float, high: float, peak: float, function: Callable[[float], float]) -> Interval:
    """Enclose sin or cos, which is 1 at ``peak`` + 2 k pi and -1 half a turn later."""
    turn = 2.0 * math.pi
    if not (math.isfinite(low) and math.isfinite(high)) or high - low >= turn or max(-low, high) > _FAR:
        return -1.0, 1.0

    def holds(angle: float) -> bool:
        return math.floor((high - angle) / turn) >= math.ceil((low - angle) / turn)

    ends = (function(low), function(high))
    return -1.0 if holds(peak + math.pi) else min(ends), 1.0 if holds(peak) else max(ends)


def _tangent(low: float, high: float) -> Interval:
    if high - low >= math.pi or math.floor(low / math.pi + 0.5) != math.floor(high / math.pi + 0.5):
        raise _UndefinedError
    return math.tan(low), math.tan(high)


def _logarithm(low: float, high: float) -> Interval:
    if low <= 0.0:
        raise _UndefinedError
    return math.log(low), math.log(high)


def _even(low: float, high: float, least: float, function: Callable[[float], float]) -> Interval:
    """Enclose a function that grows from its ``least`` value at zero to both sides."""
    ends = (_monotone(function, low), _monotone(function, high))
    return (least if low <= 0.0 <= high else min(ends)), max(ends)


_FUNCTION_ENCLOSURES: dict[str, Callable[[float, float], Interval]] = {
    "sin": lambda low, high: _wave(low, high, 0.5 * math.pi, math.sin),
    "cos": lambda low, high: _wave(low, high, 0.0, math.cos),
    "tan": _tangent,
    "sinh": lambda low, high: (_monotone(math.sinh, low), _monotone(math.sinh, high)),
    "cosh": lambda low, high: _even(low, high, 1.0, math.cosh),
    "tanh": lambda low, high: (math.tanh(low), math.tanh(high)),
    "atan": lambda low, high: (math.atan(low), math.atan(high)),
    "exp": lambda low, high: (_monotone(math.exp, low), _monotone(math.exp, high)),
    "log": _logarithm,
    "sqrt": lambda low, high: _power(low, high, 0.5),
    "abs": lambda low, high: _even(low, high, 0.0, abs),
    "sign": lambda low, high: ((1.0 if low > 0.0 else -1.0), (-1.0 if high < 0.0 else 1.0)),
}
