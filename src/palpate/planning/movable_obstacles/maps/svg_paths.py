"""The `d` and `transform` of SVG paths as points, curves flattened to chords."""

import math
import re

import numpy as np

from palpate.errors import PalpateError

_TOKEN = re.compile(r"([MmLlHhVvZzCcQqSsTtAa])|([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)")
_ARC = re.compile(r"([Aa])([^MmLlHhVvZzCcQqSsTtAa]*)")
_NEXT = re.compile(r"[\s,]*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)")
_COUNTS = {"M": 2, "L": 2, "H": 1, "V": 1, "Z": 0, "C": 6, "Q": 4, "S": 4, "T": 2, "A": 7}
_CHORDS = 12  # of a curve or a quarter circle: within 0.3 % of its radius
_MOST = 200_000  # characters of a path
_LARGEST = 1e9  # of any number: then no product of them overflows
_SMALLEST = 1e-9  # of what is no point: shorter than anything that is drawn
_TRANSFORM = re.compile(r"(matrix|translate|scale|rotate|skewX|skewY)\s*\(([^)]*)\)")


def path_outlines(d: str, what: str) -> list[np.ndarray]:
    """The closed or open outlines in `d`, each of points (points, 2), in the drawing's units.

    Understands M L H V Z C S Q T A and their relative forms. A move that nothing is drawn after is
    no outline, unless there is no other. Raises `PalpateError` for anything else, a path that does
    not begin with a move, one that is too long, and numbers that are not finite.
    """
    if len(d) > _MOST:
        raise PalpateError(f"{what} has a path of {len(d)} characters: expected at most {_MOST}")
    rest = _TOKEN.sub("", d)
    if re.search(r"[^\s,]", rest):
        raise PalpateError(
            f"{what} has {rest.strip()[:20]!r} in its path: expected the commands "
            "M L H V Z C S Q T A and numbers"
        )
    tokens = _TOKEN.findall(_ARC.sub(_separate_flags, d))
    if not tokens or tokens[0][0] not in ("M", "m"):
        raise PalpateError(f"{what} has a path that does not begin with M: {d[:30]!r}")
    outlines: list[list[np.ndarray]] = []
    here = begin = np.zeros(2)
    handle: np.ndarray | None = None  # the last control point, for S and T
    command, position = "", 0
    closed = False
    while position < len(tokens):
        letter = tokens[position][0]
        if letter:
            command, position = letter, position + 1
        elif command in ("Z", "z"):
            raise PalpateError(f"{what} has numbers after its outline was closed")
        kind = command.upper()
        if kind == "Z":
            here, handle, closed = begin, None, True
            continue
        count = _COUNTS[kind]
        numbers = _numbers([text for _, text in tokens[position : position + count]], what)
        if len(numbers) < count:
            raise PalpateError(f"{what} has a path command {command} with too few numbers")
        if kind == "A" and not set(numbers[3:5]) <= {0.0, 1.0}:
            raise PalpateError(f"{what} has an arc with other flags than 0 and 1, each by itself")
        position += count
        base = here if command.islower() else np.zeros(2)
        new, handle = _draw(kind, numbers, here, base, handle)
        if kind == "M":
            begin = new[-1]
            outlines.append([])
            command = "l" if command == "m" else "L"
        elif closed:  # drawing goes on where the last outline began
            outlines.append([here])
        outlines[-1].extend(new)
        here, closed = new[-1], False
    every = [np.array(points) for points in outlines]
    return [points for points in every if len(points) > 1] or every[:1]


def _separate_flags(arc: re.Match[str]) -> str:
    """An arc command whose flags stand apart: `a 5 5 0 01-20 20` may be written without spaces."""
    rest, separated, position, count = arc[2], [arc[1]], 0, 0
    while match := _NEXT.match(rest, position):
        number = match[1]
        flag = count % _COUNTS["A"] in (3, 4) and number[0] in "01"
        if flag and (number.isdigit() or float(number) not in (0.0, 1.0)):  # not one written as 1.0
            number = number[0]
        separated.append(number)
        position = match.start(1) + len(separated[-1])
        count += 1
    separated.append(rest[position:])
    return " ".join(separated)


def _numbers(texts: list[str], what: str) -> np.ndarray:
    """Those before the first text that is none, as an array; each is bounded."""
    texts = texts[: texts.index("")] if "" in texts else texts
    numbers = np.array([float(text) for text in texts])
    if not (np.abs(numbers) <= _LARGEST).all():
        raise PalpateError(
            f"{what} has a number that is not between -{_LARGEST:g} and {_LARGEST:g}: expected "
            "places in the drawing"
        )
    return numbers


def _draw(
    kind: str, numbers: np.ndarray, here: np.ndarray, base: np.ndarray, handle: np.ndarray | None
) -> tuple[list[np.ndarray], np.ndarray | None]:
    """The points that a command adds, and the control point that the next one may mirror."""
    along = np.linspace(0, 1, _CHORDS + 1)[1:, None]
    if kind == "H":
        return [np.array([numbers[0] + base[0], here[1]])], None
    if kind == "V":
        return [np.array([here[0], numbers[0] + base[1]])], None
    if kind == "A":
        return _arc(here, numbers[:5], numbers[5:] + base), None
    places = numbers.reshape(-1, 2) + base
    if kind in ("M", "L"):
        return [places[0]], None
    if kind in ("S", "T"):
        mirrored = here if handle is None else 2 * here - handle
        places = np.vstack([mirrored, places])
    if kind in ("C", "S"):
        first, second, end = places
        curve = (
            (1 - along) ** 3 * here
            + 3 * (1 - along) ** 2 * along * first
            + 3 * (1 - along) * along**2 * second
            + along**3 * end
        )
        return list(curve), second
    first, end = places
    curve = (1 - along) ** 2 * here + 2 * (1 - along) * along * first + along**2 * end
    return list(curve), first


def _arc(begin: np.ndarray, numbers: np.ndarray, end: np.ndarray) -> list[np.ndarray]:
    """An elliptic arc from its ends: SVG 1.1, appendix F.6."""
    rx, ry = np.abs(numbers[:2])
    if min(rx, ry) < _SMALLEST or np.allclose(begin, end, rtol=0, atol=_SMALLEST):
        return [end]
    tilt, large, sweep = math.radians(numbers[2]), bool(numbers[3]), bool(numbers[4])
    turn = np.array([[math.cos(tilt), math.sin(tilt)], [-math.sin(tilt), math.cos(tilt)]])
    x, y = turn @ (begin - end) / 2
    scale = max(1.0, math.sqrt((x / rx) ** 2 + (y / ry) ** 2))
    rx, ry = rx * scale, ry * scale
    square = (rx * ry) ** 2 / ((rx * y) ** 2 + (ry * x) ** 2) - 1
    factor = math.sqrt(max(0.0, square)) * (-1 if large == sweep else 1)
    centre = factor * np.array([rx * y / ry, -ry * x / rx])
    first = math.atan2((y - centre[1]) / ry, (x - centre[0]) / rx)
    last = math.atan2((-y - centre[1]) / ry, (-x - centre[0]) / rx)
    if sweep and last < first:
        last += 2 * math.pi
    if not sweep and last > first:
        last -= 2 * math.pi
    chords = math.ceil(_CHORDS * abs(last - first) / (math.pi / 2) - 1e-6)
    angles = np.linspace(first, last, max(1, chords) + 1)[1:]
    circle = np.stack([rx * np.cos(angles), ry * np.sin(angles)], axis=1) + centre
    points = list(circle @ turn + (begin + end) / 2)
    points[-1] = end
    return points


def transform_matrix(text: str, what: str) -> np.ndarray:
    """A `transform` attribute as a matrix (3, 3); raises `PalpateError` for one it cannot read."""
    matrix = np.eye(3)
    if re.search(r"[^\s,]", _TRANSFORM.sub("", text)):
        raise PalpateError(
            f"{what} has the transform {text[:40]!r}: expected matrix, translate, "
            "scale, rotate, skewX or skewY"
        )
    for name, inside in _TRANSFORM.findall(text):
        try:
            numbers = [float(number) for number in re.split(r"[\s,]+", inside.strip())]
            step = _step(name, numbers)
        except (ValueError, IndexError) as error:
            raise PalpateError(f"{what} has the transform {name}({inside[:30]})") from error
        matrix = compose(matrix, step, what)
    return matrix


def compose(outer: np.ndarray, inner: np.ndarray, what: str) -> np.ndarray:
    """The product of two matrices (3, 3), the second applied first.

    Raises `PalpateError` where it is not finite or much too large for any drawing.
    """
    if np.abs(inner).max() <= _LARGEST:  # False for NaN
        product = outer @ inner
        if np.abs(product).max() <= _LARGEST:
            return product
    raise PalpateError(f"{what} has a transform beyond {_LARGEST:g}: expected finite numbers")


def _step(name: str, numbers: list[float]) -> np.ndarray:
    a, b, c, d, e, f = 1.0, 0.0, 0.0, 1.0, 0.0, 0.0
    if name == "matrix":
        a, b, c, d, e, f = numbers
    elif name == "translate":
        e, f = numbers[0], numbers[1] if len(numbers) > 1 else 0.0
    elif name == "scale":
        a, d = numbers[0], numbers[1] if len(numbers) > 1 else numbers[0]
    elif name == "rotate":
        angle = math.radians(numbers[0])
        a, b, c, d = math.cos(angle), math.sin(angle), -math.sin(angle), math.cos(angle)
        if len(numbers) > 2:
            x, y = numbers[1:3]
            e, f = x - a * x - c * y, y - b * x - d * y
    elif name == "skewX":
        c = math.tan(math.radians(numbers[0]))
    else:
        b = math.tan(math.radians(numbers[0]))
    return np.array([[a, c, e], [b, d, f], [0.0, 0.0, 1.0]])
