"""Modules under the names that they had before version 0.2, with a DeprecationWarning."""

import functools
import importlib
import importlib.abc
import importlib.util
import sys
import warnings
from collections.abc import Mapping


class _Finder(importlib.abc.MetaPathFinder, importlib.abc.Loader):
    """Finds what no other finder does: a former name, whose attributes are today's module's."""

    def __init__(self, names: Mapping[str, str]):
        self.names = names

    def find_spec(self, fullname, path=None, target=None):
        if fullname not in self.names:
            return None
        return importlib.util.spec_from_loader(fullname, self)

    def exec_module(self, module):
        today = self.names[module.__name__]
        warnings.warn(f"{module.__name__} is now {today}.", DeprecationWarning, stacklevel=2)
        module.__dict__["__getattr__"] = functools.partial(getattr, importlib.import_module(today))


def hand_on(names: Mapping[str, str]) -> None:
    """Let `import former` give what `names[former]` holds; modules load when asked for."""
    sys.meta_path.append(_Finder(names))


hand_on(
    {
        "oceaninv.attenuation": "oceaninv.water.attenuation",
        "oceaninv.bio_optics": "oceaninv.water.bio_optics",
        "oceaninv.camera": "oceaninv.scene.camera",
        "oceaninv.inelastic": "oceaninv.water.inelastic",
        "oceaninv.iops": "oceaninv.water.iops",
        "oceaninv.light": "oceaninv.scene.light",
        "oceaninv.media": "oceaninv.mie.media",
        "oceaninv.mitsuba": "oceaninv.water.mitsuba_export",
        "oceaninv.objects": "oceaninv.scene.objects",
        "oceaninv.optics": "oceaninv.foundation.interface_optics",
        "oceaninv.particles": "oceaninv.mie.particles",
        "oceaninv.phase": "oceaninv.water.phase",
        "oceaninv.range_map": "oceaninv.scene.range_map",
        "oceaninv.scene_file": "oceaninv.scene.scene_file",
        "oceaninv.spectrum": "oceaninv.foundation.spectrum",
        "oceaninv.tables": "oceaninv.foundation.tables",
        "oceaninv.waves": "oceaninv.scene.waves",
        "oceaninv.transport.four_stream": "oceaninv.transport.closed_form.four_stream",
        "oceaninv.transport.kd": "oceaninv.transport.closed_form.kd",
        "oceaninv.transport.shadows": "oceaninv.transport.objects.shadows",
        "oceaninv.transport.two_stream": "oceaninv.transport.closed_form.two_stream",
    }
)
