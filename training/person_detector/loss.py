"""Loss of the detector: complete IoU for boxes, quality focal loss for objectness.

The objectness target rises from 0.1 at an IoU of 0.3 to 1 at 0.6. It approximates the probability that a person is
there and the box is correct; the IoU of a small person would depend more on the pixel size.
"""

from __future__ import annotations

import math

import torch
from network import Head
from target_assignment import RANGES, closest_anchor, responsible_cells
from torch.nn import functional


def complete_iou(one: torch.Tensor, other: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Return IoU and complete IoU of boxes (n, 4): x, y of the centre, width, height."""
    low = torch.maximum(one[:, :2] - one[:, 2:] / 2, other[:, :2] - other[:, 2:] / 2)
    high = torch.minimum(one[:, :2] + one[:, 2:] / 2, other[:, :2] + other[:, 2:] / 2)
    common = (high - low).clamp(min=0).prod(1)
    iou = common / (one[:, 2:].prod(1) + other[:, 2:].prod(1) - common + 1e-9)
    least = torch.minimum(one[:, :2] - one[:, 2:] / 2, other[:, :2] - other[:, 2:] / 2)
    most = torch.maximum(one[:, :2] + one[:, 2:] / 2, other[:, :2] + other[:, 2:] / 2)
    diagonal = (most - least).square().sum(1) + 1e-9
    apart = (one[:, :2] - other[:, :2]).square().sum(1) / diagonal
    shape = (4 / math.pi**2) * (torch.atan(one[:, 2] / one[:, 3]) - torch.atan(other[:, 2] / other[:, 3])).square()
    with torch.no_grad():
        share = shape / (1 - iou + shape + 1e-9)
    return iou, iou - apart - share * shape


def decode(head: Head, raw: torch.Tensor, anchor: torch.Tensor, cells: torch.Tensor) -> torch.Tensor:
    """Return boxes (n, 4), x, y, w, h in px, of raw outputs (n, 4+) in cells (n, 2) x, y."""
    middle = (torch.sigmoid(raw[:, :2]) * head.scale - 0.5 * (head.scale - 1) + cells) * head.stride
    return torch.cat([middle, anchor * torch.exp(raw[:, 2:4].clamp(-4, 4))], 1)


def detection_loss(
    heads: list[Head], outputs: list[torch.Tensor], people: torch.Tensor, box_weight: float = 2.0
) -> tuple[torch.Tensor, dict[str, float]]:
    """Return the loss of a batch and its parts.

    Args:
        heads, outputs: yolo layers of the network and their raw outputs.
        people: (n, 6) crop, xmin, ymin, xmax, ymax, certain.
        box_weight: weight of the box loss relative to the objectness loss.
    """
    corners = people[:, 1:5]
    centred = torch.cat([(corners[:, :2] + corners[:, 2:]) / 2, corners[:, 2:] - corners[:, :2]], 1)
    rows = torch.cat([people[:, :1], centred, people[:, 5:6]], 1)
    box_loss, object_loss = torch.zeros(()), torch.zeros(())
    found, overlap = 0, 0.0
    for head, output in zip(heads, outputs, strict=True):
        height, width = output.shape[2:4]
        (low, high), (may_low, may_high) = RANGES[head.stride]
        sure = rows[:, 5] > 0.5
        mine = sure & (rows[:, 4] >= low) & (rows[:, 4] < high)
        either = ~mine & (~sure | ((rows[:, 4] >= may_low) & (rows[:, 4] < may_high)))
        target = torch.zeros(output.shape[:4])
        weight = torch.ones(output.shape[:4])
        for crop, left, top, right, bottom in zip(
            people[either, 0].long().tolist(),
            *[(people[either, i] / head.stride).tolist() for i in range(1, 5)],
            strict=True,
        ):
            weight[crop, :, int(top) : math.ceil(bottom), int(left) : math.ceil(right)] = 0.0
        chosen = rows[mine]
        if len(chosen):
            index, cells = responsible_cells(head, chosen, (height, width))
            want = chosen[index]
            crop, x, y = want[:, 0].long(), cells[:, 0].long(), cells[:, 1].long()
            which = closest_anchor(head, want)
            raw = output[crop, which, y, x]
            iou, complete = complete_iou(decode(head, raw, head.anchors[which], cells), want[:, 1:5])
            box_loss = box_loss + (1 - complete).sum()
            quality = ((iou.detach() - 0.3) / 0.3).clamp(0.1, 1.0)
            order = torch.argsort(quality)
            target[crop[order], which[order], y[order], x[order]] = quality[order]
            weight[crop, which, y, x] = 1.0
            found += len(index)
            overlap += float(iou.detach().sum())
        logit = output[..., 4]
        difference = (torch.sigmoid(logit) - target).abs()
        focal = functional.binary_cross_entropy_with_logits(logit, target, reduction="none")
        object_loss = object_loss + (focal * difference.pow(2) * weight).sum()
    count = max(found, 1)
    loss = (box_weight * box_loss + 3.0 * object_loss) / count
    return loss, {
        "box": float(box_loss.detach()) / count,
        "object": float(object_loss.detach()) / count,
        "iou": overlap / count,
    }
