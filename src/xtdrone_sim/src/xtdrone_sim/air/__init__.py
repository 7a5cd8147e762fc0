"""Air: wind, gusts, drag and the wakes of rotors, as effects on the vehicles.

Each class is an effect of ``xtdrone_sim.effects``, known in the list of effects by its name in ``AIR``.
"""

from xtdrone_sim.air.rotor_wakes import Downwash, GroundEffect
from xtdrone_sim.air.wind import WindField, WindRegion

from .body_drag import BodyDrag
from .dryden import Dryden

AIR = {
    "dryden": Dryden,
    "wind_region": WindRegion,
    "wind_field": WindField,
    "ground_effect": GroundEffect,
    "downwash": Downwash,
    "body_drag": BodyDrag,
}
