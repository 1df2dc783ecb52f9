"""Models of the light field, from closed forms to exact; all answer the same questions."""

# fmt: off
# isort: off
from oceaninv.transport import apparent
from oceaninv.transport.base import Estimate, Irradiance
from oceaninv.transport.closed_form import kd
from oceaninv.transport.closed_form.four_stream import FourStream
from oceaninv.transport.closed_form.kd import KdTransport
from oceaninv.transport.closed_form.two_stream import TwoStream
from oceaninv.transport.energy import EnergyBudget, energy_budget
from oceaninv.transport.front import irradiance, photograph, radiance
from oceaninv.transport.monte_carlo.monte_carlo import MonteCarlo
from oceaninv.transport.objects.shadows import Shadows, WithObjects
from oceaninv.transport.plane_parallel.plane_parallel import PlaneParallel

__all__ = [
    "EnergyBudget", "Estimate", "FourStream", "Irradiance", "KdTransport", "MonteCarlo",
    "PlaneParallel", "Shadows", "TwoStream", "WithObjects", "apparent", "energy_budget",
    "irradiance", "kd", "photograph", "radiance"]
