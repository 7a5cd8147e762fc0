"""Air: wind, gusts, drag and the wakes of rotors, as effects on the vehicles.

Each class is an effect of ``xtdrone_sim.effects``, known in the list of effects by its name in ``AIR``.
"""

from .body_drag import BodyDrag
from .downwash import Downwash
from .dryden import Dryden
from .ground_effect import GroundEffect
from .wind_field import WindField
from .wind_region import WindRegion

AIR = {
    "dryden": Dryden,
    "wind_region": WindRegion,
    "wind_field": WindField,
    "ground_effect": GroundEffect,
    "downwash": Downwash,
    "body_drag": BodyDrag,
}
