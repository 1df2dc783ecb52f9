"""Several casts of one station as one."""

from collections.abc import Sequence

import numpy as np

from fitting.observations.profile import Profile
from fitting.profile.fit_profiles import fit_profiles


def merged(profiles: Sequence[Profile]) -> Profile:
    """All samples of casts through the same water, each rid of darkness and of changing light.

    The light of each is brought to that of the first: by the light above, where all casts have it
    in the unit of Ed, else by their own fitted Ed(0-).  Waves then differ between casts, and the
    fit of all is the fit of their common Kd.  PAR, which has no such standard, is left out.  Place
    and time are those of the first.

    Raises ValueError where bands or the place of the upward sensors differ.
    """
    if not profiles:
        raise ValueError("there is no cast to merge.")
    first = profiles[0]
    for other in profiles[1:]:
        if not np.array_equal(other.wavelength, first.wavelength):
            raise ValueError(f"{other.source} and {first.source} have different bands.")
        if other.upward_below != first.upward_below:
            raise ValueError("the upward sensors of the casts hang at different depths.")
    above = [profile.Es for profile in profiles]
    if all(Es is not None and np.all(np.isfinite(Es)) for Es in above):
        level = np.array(above)
    else:
        fits = fit_profiles(profiles)
        level = np.array([fit.quantities["Ed_0"].value for fit in fits])
    gains = level[0] / level

    def joined(name: str):
        parts = [getattr(profile, name) for profile in profiles]
        if any(part is None for part in parts):
            return None
        rows = []
        for profile, part, gain in zip(profiles, parts, gains, strict=True):
            value = part - profile.dark if name == "Ed" else part
            # What a cast had masked stays masked, whatever its sign is now.
            value = np.where(profile.mask, value, np.nan) if name == "Ed" else value
            reference = 1.0 if profile.reference is None else profile.reference
            rows.append(value * gain / reference)
        return np.concatenate(rows)

    surface = None
    if first.Es is not None and all(Es is not None for Es in above):
        surface = np.tile(first.Es, (sum(len(p.depth) for p in profiles), 1))
    counts: dict[str, int] = {"casts merged": len(profiles)}
    for profile in profiles:
        for reason, count in profile.counts.items():
            counts[reason] = counts.get(reason, 0) + count
    tilts = [profile.tilt for profile in profiles if profile.tilt is not None]
    return Profile(
        np.concatenate([profile.depth for profile in profiles]),
        first.wavelength,
        joined("Ed"),
        joined("sigma"),
        solar_zenith=first.solar_zenith,
        source=f"{first.source} and {len(profiles) - 1} more",
        Eu=joined("Eu"),
        Lu=joined("Lu"),
        surface=surface,
        tilt=np.concatenate(tilts) if len(tilts) == len(profiles) else None,
        upward_below=first.upward_below,
        counts=counts,
        station=first.station,
    )
