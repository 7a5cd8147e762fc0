"""Names of topics, services and parameters that clients give: the one check before a name reaches rospy or the master.

rospy retries without end a registration that the ROS master answers with a fault, and holds its locks meanwhile. A name
with a character that XML cannot contain has that answer: one client would stop the process for all.
"""

from __future__ import annotations

import re

from xtdrone_common.files import shortened

LONGEST_NAME = 255
"""Characters of a name."""
_NAME = re.compile(r"/?[A-Za-z]\w*(/\w+)*/?|(/\w+)+/?", re.ASCII)
_SHOWN = 80  # characters of a name quoted in an error


class RosNameError(ValueError):
    """A name that ROS does not resolve."""


def absolute_name(name: object, what: str) -> str:
    """Return the absolute name, such as ``/iris_0/mavros/state``; the slash before it may be missing.

    Source: wiki.ros.org/Names; ASCII letters, digits, ``_`` and ``/``; a relative name begins with a letter. Private
    names (``~a``) are not accepted, as they would be those of the bridge.

    Args:
        name: as given by a client.
        what: the parameter of the client's request, for the error.

    Raises:
        RosNameError: it is not a name.
    """
    if not isinstance(name, str) or len(name) > LONGEST_NAME or not _NAME.fullmatch(name):
        raise RosNameError(
            f"{what}: {shortened(ascii(name), _SHOWN)} is not allowed, a name such as /iris_0/mavros/state"
        )
    return f"/{name.strip('/')}"
