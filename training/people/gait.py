"""A walk on flat ground and a stance, as rotations and positions of the joints.

The feet are prescribed and the legs follow by inverse kinematics: a foot that stands moves back exactly as fast as
the body goes ahead, so that feet do not slide. Percentages of the cycle after Perry, Gait Analysis (heel strike at 0,
foot flat at 8 %, heel off at 38 %, toe off at 62 %).

Frames: x ahead, y left, z up, metres; the origin lies on the ground below the pelvis.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from makehuman import JOINT, JOINTS

_FLAT, _HEEL_OFF, _TOE_OFF = 0.08, 0.38, 0.62  # fractions of the cycle
_STRIKE, _PUSH = np.radians(-18.0), np.radians(48.0)  # pitch of the foot, positive: toes down


@dataclass(frozen=True)
class Style:
    """Parameters of a person's gait.

    Attributes:
        stride: length of a cycle of two steps as a share of the height.
        swing: swing of the arms, degrees.
        elbow: minimum bend of the elbows, degrees.
        lean: forward lean of the trunk, degrees.
        width: distance between the ankles as a share of the height.
    """

    stride: float = 0.74
    swing: float = 24.0
    elbow: float = 8.0
    lean: float = 3.0
    width: float = 0.085


def _rotation(axis: int, angle: float) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    out = np.eye(3)
    i, j = (axis + 1) % 3, (axis + 2) % 3
    out[i, i] = out[j, j] = c
    out[i, j], out[j, i] = -s, s
    return out


def _frame(along: np.ndarray, ahead: np.ndarray) -> np.ndarray:
    """Return axes as columns: ``along``, the component of ``ahead`` perpendicular to it, and their cross product."""
    e1 = along / np.linalg.norm(along)
    e2 = ahead - e1 * (ahead @ e1)
    e2 /= np.linalg.norm(e2)
    return np.column_stack([e1, e2, np.cross(e1, e2)])


def _turn(before: np.ndarray, after: np.ndarray, ahead: np.ndarray) -> np.ndarray:
    """Return the rotation of a bone's direction to another that keeps the front in front."""
    x = np.array([1.0, 0.0, 0.0])
    return _frame(after, ahead) @ _frame(before, x).T


class Walker:
    """Poses a body by its joints at rest, (J, 3)."""

    def __init__(self, rest: np.ndarray, height: float, style: Style) -> None:
        self._rest = rest
        self._style = style
        self.stride = style.stride * height
        self._width = 0.5 * style.width * height
        self._leg = self._length("thigh_l", "calf_l") + self._length("calf_l", "foot_l")

    def _length(self, first: str, second: str) -> float:
        return float(np.linalg.norm(self._rest[JOINT[first]] - self._rest[JOINT[second]]))

    def standing(self) -> np.ndarray:
        """Return the transforms (J, 3, 4) of the stance: rest position to posed position."""
        pose = _Pose(self._rest)
        pose.trunk(self._hips(0.0, 0.0, 0.0), 0.0, 0.0)
        for side, sign in (("l", 1.0), ("r", -1.0)):
            ankle = np.array([0.0, sign * 0.9 * self._width, self._rest[JOINT["foot_" + side]][2]])
            pose.leg(side, ankle, 0.0, 0.0, sign * np.radians(8.0))
            pose.arm(side, np.radians(-2.0), np.radians(10.0), np.radians(9.0))
        return pose.matrices()

    def walking(self, phase: float) -> np.ndarray:
        """Return the transforms (J, 3, 4) at a phase, cycles; at 0 the left heel strikes."""
        style, pose = self._style, _Pose(self._rest)
        turn = np.radians(5.0) * np.cos(2 * np.pi * phase)  # at 0 the left hip is ahead, so the pelvis is turned right
        pose.trunk(self._hips(phase, -turn, 1.0), np.radians(style.lean), 1.3 * turn)
        for side, sign, own in (("l", 1.0, phase), ("r", -1.0, phase + 0.5)):
            x, z, pitch, toes = self._foot(side, own % 1.0)
            pose.leg(side, np.array([x, sign * self._width, z]), pitch, toes, sign * np.radians(6.0))
            # An arm swings with the opposite leg.
            swing = -np.radians(style.swing) * np.cos(2 * np.pi * own)
            bend = np.radians(style.elbow + 0.3 * style.swing) + 0.35 * swing
            pose.arm(side, swing, bend, np.radians(10.0))
        return pose.matrices()

    def _hips(self, phase: float, yaw: float, walks: float) -> tuple[np.ndarray, float]:
        """Return position and yaw of the pelvis, as high as the legs reach."""
        mid = 0.5 * (self._rest[JOINT["thigh_l"]] + self._rest[JOINT["thigh_r"]])
        ankle = self._rest[JOINT["foot_l"]][2]
        drop = self._drop() if walks else 0.005 * self._leg
        height = ankle + self._leg - drop - walks * 0.025 * self._leg * np.cos(4 * np.pi * phase)
        return np.array([0.0, 0.0, height + self._rest[JOINT["pelvis"]][2] - mid[2]]), yaw

    def _drop(self) -> float:
        """Return the drop of the mean hip below straight legs with which both legs always reach their ankles."""
        need = 0.0
        ankle = self._rest[JOINT["foot_l"]][2]
        side = abs(abs(self._rest[JOINT["thigh_l"]][1]) - self._width)
        for phase in np.arange(0.0, 1.0, 0.02):
            x, z, _, _ = self._foot("l", phase)
            reach = np.sqrt(max((0.992 * self._leg) ** 2 - (abs(x) - 0.01) ** 2 - side**2, 0.0))
            hip = z + reach - ankle
            need = max(need, self._leg - hip - 0.025 * self._leg * np.cos(4 * np.pi * phase))
        return need

    def _foot(self, side: str, phase: float) -> tuple[float, float, float, float]:
        """Return the ankle's x and z, the pitch of the foot and that of the toes."""
        if phase <= _TOE_OFF:
            return self._on_ground(side, phase)
        x0, z0, pitch0, _ = self._on_ground(side, _TOE_OFF)
        x1, z1, pitch1, _ = self._on_ground(side, 0.0)
        s = (phase - _TOE_OFF) / (1.0 - _TOE_OFF)
        smooth = s * s * (3.0 - 2.0 * s)
        lift = 0.09 * self._leg * np.sin(np.pi * s) ** 2 * (1.0 - 0.6 * s)
        pitch = pitch0 + (pitch1 - pitch0) * min(1.0, 1.35 * smooth)
        return x0 + (x1 - x0) * smooth, z0 + (z1 - z0) * smooth + lift, pitch, min(pitch, 0.0) + 0.3 * max(pitch, 0.0)

    def _on_ground(self, side: str, phase: float) -> tuple[float, float, float, float]:
        ankle, ball = self._rest[JOINT["foot_" + side]], self._rest[JOINT["ball_" + side]]
        back = 0.045 * self._leg
        x = self.stride * (0.5 * _TOE_OFF - phase) - 0.10 * self._leg
        if phase < _FLAT:
            pitch = _STRIKE * (1.0 - phase / _FLAT)
            pivot = np.array([-back, 0.0])
        elif phase < _HEEL_OFF:
            return x, float(ankle[2]), 0.0, 0.0
        else:
            share = (phase - _HEEL_OFF) / (_TOE_OFF - _HEEL_OFF)
            pitch = _PUSH * share**1.6
            pivot = np.array([ball[0] - ankle[0], float(ball[2])])
        arm = np.array([0.0, ankle[2]]) - pivot
        c, s = np.cos(pitch), np.sin(pitch)
        moved = pivot + np.array([c * arm[0] + s * arm[1], -s * arm[0] + c * arm[1]])
        return x + moved[0], moved[1], pitch, min(pitch, 0.0)


class _Pose:
    """Rotations and positions of the joints."""

    def __init__(self, rest: np.ndarray) -> None:
        self._rest = rest
        self._turns = [np.eye(3) for _ in JOINTS]
        self._places = rest.copy()

    def trunk(self, hips: tuple[np.ndarray, float], lean: float, twist: float) -> None:
        """Place pelvis, spine, chest, neck and head."""
        place, yaw = hips
        self._places[JOINT["pelvis"]] = place
        self._turns[JOINT["pelvis"]] = _rotation(2, yaw)
        for name, share, tilt in (("spine", 0.4, 0.6), ("chest", 1.0, 1.0), ("neck", 0.5, 1.0), ("head", 0.0, 0.6)):
            angle = yaw * (1.0 - share) + twist * share if name in ("spine", "chest") else twist * share
            self._follow(name, _rotation(2, angle) @ _rotation(1, lean * tilt))

    def _follow(self, name: str, turn: np.ndarray) -> None:
        """Set a joint's rotation; its position follows from its parent."""
        i = JOINT[name]
        parent = JOINT[JOINTS[i][1]]
        self._places[i] = self._places[parent] + self._turns[parent] @ (self._rest[i] - self._rest[parent])
        self._turns[i] = turn

    def _bone(self, first: str, second: str) -> np.ndarray:
        return self._rest[JOINT[second]] - self._rest[JOINT[first]]

    def leg(self, side: str, ankle: np.ndarray, pitch: float, toes: float, yaw: float) -> None:
        """Place a leg so that it reaches the ankle; ``pitch`` of the foot, ``toes`` likewise, ``yaw`` outwards."""
        thigh, calf, foot, ball = (f"{name}_{side}" for name in ("thigh", "calf", "foot", "ball"))
        self._follow(thigh, np.eye(3))
        hip = self._places[JOINT[thigh]]
        upper, lower = self._bone(thigh, calf), self._bone(calf, foot)
        a, b = np.linalg.norm(upper), np.linalg.norm(lower)
        span = ankle - hip
        distance = min(float(np.linalg.norm(span)), 0.9999 * (a + b))
        ahead = np.array([np.cos(yaw), np.sin(yaw), 0.0])
        axes = _frame(span, ahead)
        cosine = (a * a + distance * distance - b * b) / (2.0 * a * distance)
        along = axes[:, 0] * cosine + axes[:, 1] * np.sqrt(max(1.0 - cosine * cosine, 0.0))
        knee = hip + a * along
        self._turns[JOINT[thigh]] = _turn(upper, along, ahead)
        self._follow(calf, _turn(lower, hip + span - knee, ahead))
        rest = self._bone(foot, ball)
        straighten = -np.arctan2(rest[1], rest[0])
        self._follow(foot, _rotation(2, yaw + straighten) @ _rotation(1, pitch))
        self._follow(ball, _rotation(2, yaw + straighten) @ _rotation(1, toes))

    def arm(self, side: str, swing: float, bend: float, out: float) -> None:
        """Place a hanging arm: ``swing`` forward from the shoulder, ``bend`` of the elbow, ``out`` from the body."""
        upper, lower, hand = (f"{name}_{side}" for name in ("upperarm", "lowerarm", "hand"))
        sign = 1.0 if side == "l" else -1.0

        def hanging(angle: float, away: float) -> np.ndarray:
            return np.array([np.sin(angle), sign * np.sin(away) * np.cos(angle), -np.cos(away) * np.cos(angle)])

        x = np.array([1.0, 0.0, 0.2])
        self._follow(upper, _turn(self._bone(upper, lower), hanging(swing, out), x))
        turn = _turn(self._bone(lower, hand), hanging(swing + bend, 0.2 * out), np.array([1.0, 0.0, 0.5]))
        self._follow(lower, turn)
        self._follow(hand, turn)

    def matrices(self) -> np.ndarray:
        """Return (J, 3, 4): p -> R p + t for positions at rest."""
        out = np.zeros((len(JOINTS), 3, 4))
        for i, turn in enumerate(self._turns):
            out[i, :, :3] = turn
            out[i, :, 3] = self._places[i] - turn @ self._rest[i]
        return out
