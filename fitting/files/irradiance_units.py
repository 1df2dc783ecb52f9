"""Units as people write them, told apart by what is written and never by the size of numbers."""

import math
import re

_PREFIXES = {"n": 1e-9, "u": 1e-6, "m": 1e-3, "k": 1e3, "": 1.0}
# Symbol -> (size, base unit).  A length in nm is a wavelength, one in m belongs to an area.
_SYMBOLS = {
    "m": (1.0, "m"),
    "cm": (1e-2, "m"),
    "nm": (1.0, "nm"),
    "um": (1e3, "nm"),
    "s": (1.0, "s"),
    "sec": (1.0, "s"),
    "h": (3600.0, "s"),
    "d": (86400.0, "s"),
    "day": (86400.0, "s"),
    "sr": (1.0, "sr"),
}
_SYMBOLS |= {f"{p}w": (size, "W") for p, size in _PREFIXES.items()}
_SYMBOLS |= {f"{p}{n}": (size, "mol") for p, size in _PREFIXES.items() for n in ("mol", "e", "ein")}
_QUANTUM = {"quanta": (1.0 / 6.02214076e23, "mol"), "photons": (1.0 / 6.02214076e23, "mol")}
_WORDS = (
    (r"micro-?\s*", "u"), (r"milli-?\s*", "m"), (r"nano-?\s*", "n"), (r"kilo-?\s*", "k"),
    (r"watts?", "W"), (r"einsteins?", "E"), (r"moles?", "mol "), (r"steradians?", "sr"),
    (r"centimet(?:er|re)s?", "cm"), (r"met(?:er|re)s?", "m"),
    (r"seconds?", "s"), (r"hours?|hr", "h"), (r"days?", "d"),
    (r"sq(?:uare)?[_ ]?(c?m)\b", r"\1^2"), (r"\bper\b", "/"),
)  # fmt: skip
_SUPERSCRIPTS = str.maketrans("⁰¹²³⁴⁵⁶⁷⁸⁹⁻−", "0123456789--")
_TOKEN = re.compile(r"([a-z]+)\^?([-+]?\d+)?")
_NUMBER = re.compile(r"\d+(?:\.\d+)?(?:e[-+]?\d+)?(?![a-z])")
_METRES, _DECIBARS = {"m"}, {"dbar", "decibar", "decibars", "db"}


def _plain(unit: str) -> str:
    """The text in ASCII, powers as ^n, words as symbols."""
    text = re.sub(r"[⁰¹²³⁴⁵⁶⁷⁸⁹⁻]+", lambda m: "^" + m[0].translate(_SUPERSCRIPTS), unit.strip())
    text = text.translate(_SUPERSCRIPTS).replace("µ", "u").replace("μ", "u").replace("**", "^")
    text = re.sub(r"\^\{(-?\d+)\}", r"^\1", text)
    for pattern, symbol in _WORDS:
        text = re.sub(pattern, symbol, text, flags=re.IGNORECASE)
    return text


def _parsed(unit: str) -> tuple[float, dict[str, int]] | None:
    """(size, powers of the base units), None where some part is no known unit.

    What follows a slash is divided by, as far as it carries no power of its own sign: W/m^2 nm is
    read as W/(m^2 nm), the only irradiance that it can mean.
    """
    text = _plain(unit)
    # M is mega, m is milli: only text that is all capitals leaves open which was meant.
    if re.search(r"(?<![A-Za-z])M(?=W|E\b|mol)", text):
        return None
    text = text.lower()
    photons = bool(re.search(r"mol|(?<![a-z])[numk]?e(?:in)?(?![a-z])", text))
    size, powers, below, at = 1.0, {}, False, 0
    while at < len(text):
        if text[at] in " .*·()[]":
            at += 1
            continue
        if text[at] == "/":
            below, at = True, at + 1
            continue
        number = _NUMBER.match(text, at) if not powers else None
        if number:
            size, at = size * float(number[0]), number.end()
            continue
        token = _TOKEN.match(text, at)
        if not token:
            return None
        name, power = token[1], int(token[2] or 1)
        at = token.end()
        if name in _QUANTUM and photons:
            continue  # "umol photons"
        if name not in _SYMBOLS and name not in _QUANTUM:
            return None
        scale, base = _SYMBOLS.get(name) or _QUANTUM[name]
        power = -abs(power) if below else power
        size *= scale**power
        powers[base] = powers.get(base, 0) + power
    return size, powers


def irradiance_factor(unit: str) -> float | None:
    """Factor to W m-2 nm-1 (or W m-2 nm-1 sr-1), None if the text is no such unit.

    >>> irradiance_factor("µW/(cm² nm)")
    0.01
    """
    found = _parsed(unit)
    if found is None or found[1].pop("sr", -1) != -1:
        return None
    return _rounded(found[0]) if found[1] == {"W": 1, "m": -2, "nm": -1} else None


def par_factor(unit: str) -> tuple[float, str] | None:
    """Factor to umol m-2 s-1, or to W m-2 where PAR is stated as power, and that unit.

    None if the text is no unit of PAR.
    """
    found = _parsed(unit)
    if found is None:
        return None
    if found[1] == {"mol": 1, "m": -2, "s": -1}:
        return _rounded(1e6 * found[0]), "umol m-2 s-1"
    return (_rounded(found[0]), "W m-2") if found[1] == {"W": 1, "m": -2} else None


def _rounded(factor: float) -> float:
    """Powers of ten without the rounding errors of their products."""
    power = round(math.log10(factor), 9)
    return float(f"1e{power:.0f}") if power == int(power) else factor


def irradiance_units_in(text: str) -> list[str]:
    """Every irradiance unit that a free comment states."""
    found = []
    for start in re.finditer(
        r"(?<![A-Za-z])(?:[nuµμmk]|micro|milli)?[Ww](?:atts?)?(?![A-Za-z])", text
    ):
        rest = re.match(r"[^,;\n]{0,40}", text[start.start() :])
        words = rest[0] if rest else ""
        fits = [words[:n].rstrip() for n in range(len(words), 4, -1)]
        unit = next((one for one in fits if irradiance_factor(one) is not None), None)
        if unit is not None:
            found.append(unit)
    return found


def depth_kind(unit: str) -> str | None:
    """ "m" or "dbar", None if the text is neither."""
    plain = _plain(re.sub(r"\(.*\)|\[.*\]", "", unit)).strip().lower()
    if plain in _METRES:
        return "m"
    return "dbar" if plain in _DECIBARS else None
