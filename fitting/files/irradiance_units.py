"""Units as people write them, told apart by what is written and never by the size of numbers."""

import re

# What an irradiance per wavelength is made of: prefix of watt, unit of area, unit of wavelength.
_WATT = {"u": 1e-6, "m": 1e-3, "": 1.0}
_AREA = {"cm": 1e4, "m": 1.0}
_BAND = {"nm": 1.0, "um": 1e-3}
_IRRADIANCE = re.compile(
    r"(u|m|)w[\s./*(]*(cm|m)\^?(-?)2[\s./*]*(nm|um)(?:\^?(-?)1)?\)?(?:[\s./*]*sr(?:\^?-?1)?\)?)?$"
)
_ANYWHERE = re.compile(
    r"(?<![A-Za-z])(?:[uµμm]|micro)?W[\s./*(]*c?m\^?-?2[\s./*]*[nuµμ]m(?:\^?-?1)?(?![A-Za-z0-9])"
)
_METRES = {"m", "meter", "meters", "metre", "metres"}
_DECIBARS = {"dbar", "decibar", "decibars", "db"}


def irradiance_factor(unit: str) -> float | None:
    """Factor to W m-2 nm-1 (or W m-2 nm-1 sr-1), None if the text is no such unit."""
    plain = unit.strip().replace("µ", "u").replace("μ", "u")
    plain = re.sub(r"micro-?\s*", "u", plain, flags=re.IGNORECASE)
    plain = re.sub(r"watts?", "W", plain, flags=re.IGNORECASE)
    plain = re.sub(r"sq[_ ]?(c?m)", r"\1^2", plain)
    # The case of m and M matters to nobody here, that of W neither.
    found = _IRRADIANCE.fullmatch(plain.lower())
    if not found:
        return None
    watt, area, _, band, _ = found.groups()
    return _WATT[watt] * _AREA[area] / (1.0 / _BAND[band])


def irradiance_units_in(text: str) -> list[str]:
    """Every irradiance unit that a free comment states."""
    return [match.group(0) for match in _ANYWHERE.finditer(text)]


def depth_kind(unit: str) -> str | None:
    """ "m" or "dbar", None if the text is neither."""
    plain = unit.strip().lower()
    if plain in _METRES:
        return "m"
    return "dbar" if plain in _DECIBARS else None
