"""The optics of water: pure water, constituents, phase functions, inelastic scattering."""

# fmt: off
# isort: off
from oceaninv.water.bio_optics import (
    CDOM, BioOpticalModel, Constituents, Detritus, Minerals, Phytoplankton, gutierrez2008, jerlov,
    measured_iops)
from oceaninv.water.image_forming import disc_transmission, target_transmission
from oceaninv.water.inelastic import CDOMFluorescence, ChlorophyllFluorescence, Inelastic, Raman
from oceaninv.water.iops import IOPs, Layers
from oceaninv.water.pure_water import absorption, phase_constant, scattering

__all__ = [
    "CDOM", "BioOpticalModel", "CDOMFluorescence", "ChlorophyllFluorescence", "Constituents",
    "Detritus", "IOPs", "Inelastic", "Layers", "Minerals", "Phytoplankton", "Raman", "absorption",
    "disc_transmission", "gutierrez2008", "jerlov", "measured_iops", "phase_constant", "scattering",
    "target_transmission"]
