#!/usr/bin/env python3
"""Trains the detector of people on images of make_data.py and writes darknet's .weights, a log and its curve.

train.py DATA --out RUN --minutes 60          # DATA/train and DATA/val
train.py DATA --out RUN --minutes 90 --resume # continues from the saved state
"""

from __future__ import annotations

import argparse
import copy
import csv
import json
import math
import queue
import threading
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
import torch.distributed as dist
import torch.multiprocessing as mp
from loss import decode, detection_loss
from network import Darknet, load_weights, save_weights
from pictures import Cropper, Picture, load, read_labels, read_picture

from xtdrone_perception.detection.scoring import LabelledPicture, at_threshold, average_precision, best_threshold, match

CONFIG = Path(__file__).resolve().parents[2] / "src/xtdrone_perception/config/yolo/search.cfg"
HEIGHT = 384  # px, height of the network's input; images of 360 lines get grey bars above and below
GREY = 127 / 255
SURE = 12.0  # logit of the single class, so that objectness alone decides


class Feeder(threading.Thread):
    """Prepares batches ahead of the training, and adds images that are made meanwhile."""

    def __init__(self, cropper: Cropper, batch: int, folder: Path, read: int):
        super().__init__(daemon=True)
        self.cropper, self.count, self.folder, self.read = cropper, batch, folder, read
        self.queue: queue.Queue[Any] = queue.Queue(8)
        self.hard: list[tuple[str, float, float]] = []

    def run(self) -> None:
        """Fill the queue until the process ends."""
        looked = time.monotonic()
        while True:
            if time.monotonic() - looked > 60:
                self.read = load(self.cropper, self.folder, self.read)
                self._read_hard()
                looked = time.monotonic()
            self.queue.put(self.cropper.batch(self.count))

    def _read_hard(self) -> None:
        path = self.folder / "hard.json"
        if path.exists():
            number = {picture.name: index for index, picture in enumerate(self.cropper.pictures)}
            self.cropper.hard = [(number[n], x, y) for n, x, y in json.loads(path.read_text()) if n in number]


class Average:
    """A running mean of the network's parameters, which detects better than the last parameters."""

    def __init__(self, network: Darknet, decay: float = 0.998):
        self.network = copy.deepcopy(network).eval()
        self.decay, self.steps = decay, 0

    def update(self, network: Darknet) -> None:
        """Update the mean with the parameters after a step."""
        self.steps += 1
        keep = self.decay * (1 - math.exp(-self.steps / 300))
        with torch.no_grad():
            mine, theirs = self.network.state_dict(), network.state_dict()
            for name, value in mine.items():
                if value.dtype.is_floating_point:
                    value.mul_(keep).add_(theirs[name], alpha=1 - keep)
                else:
                    value.copy_(theirs[name])


def begin(network: Darknet) -> None:
    """Initialize the outputs with a low probability everywhere."""
    for output in network.outputs():
        torch.nn.init.normal_(output.weight, std=0.01)
        assert output.bias is not None
        with torch.no_grad():
            output.bias.zero_()
            output.bias.view(-1, 5 + network.classes)[:, 4] = -4.5


def seal(network: Darknet) -> None:
    """Make the single class certain, so that a box's probability is its objectness."""
    with torch.no_grad():
        for output in network.outputs():
            assert output.bias is not None
            output.weight.view(-1, 5 + network.classes, output.weight.shape[1])[:, 5:] = 0.0
            output.bias.view(-1, 5 + network.classes)[:, 5:] = SURE


def tensor(images: np.ndarray) -> torch.Tensor:
    """Return crops (n, h, w, 3) uint8 as (n, 3, h, w) 0..1."""
    return torch.from_numpy(images).permute(0, 3, 1, 2).to(torch.float32, memory_format=torch.channels_last).div_(255)


def find(network: Darknet, image: np.ndarray, least: float = 0.02) -> tuple[np.ndarray, np.ndarray]:
    """Return boxes (n, 4) px and scores in an image (360, 640, 3), the best of each group with overlap above 0.45."""

    bar = (HEIGHT - image.shape[0]) // 2
    x = torch.full((1, 3, HEIGHT, image.shape[1]), GREY)
    x[0, :, bar : bar + image.shape[0]] = torch.from_numpy(image).permute(2, 0, 1).float() / 255
    boxes, scores = [], []
    with torch.no_grad():
        for head, output in zip(network.heads, network(x), strict=True):
            score = torch.sigmoid(output[0, ..., 4])
            which, rows, columns = torch.nonzero(score > least, as_tuple=True)
            raw = output[0, which, rows, columns]
            box = decode(head, raw, head.anchors[which], torch.stack([columns, rows], 1).float())
            boxes.append(torch.cat([box[:, :2] - box[:, 2:] / 2, box[:, :2] + box[:, 2:] / 2], 1))
            scores.append(score[which, rows, columns])
    corners = torch.cat(boxes).numpy() - np.array([0, bar, 0, bar], np.float32)
    score = torch.cat(scores).numpy()
    corners = np.clip(corners, 0, np.array([image.shape[1], image.shape[0]] * 2))
    sizes = np.column_stack([corners[:, :2], corners[:, 2:] - corners[:, :2]])
    kept = np.array(cv2.dnn.NMSBoxes(sizes.tolist(), score.tolist(), least, 0.45), int).reshape(-1)
    return corners[kept], score[kept]


def judge(network: Darknet, pictures: list[Picture]) -> dict[str, float]:
    """Return average precision for all people that count and for 12 to 20 px, and metrics at the best threshold."""
    scenes = [
        LabelledPicture(
            *find(network, picture.image),
            picture.boxes,
            picture.certain & (picture.boxes[:, 3] - picture.boxes[:, 1] >= 12),
        )
        for picture in pictures
    ]
    every, small = match(scenes, heights=(12, math.inf)), match(scenes, heights=(12, 20))
    threshold = best_threshold(every)
    precision, recall, false = at_threshold(every, threshold)
    return {
        "ap": average_precision(every),
        "ap_small": average_precision(small),
        "threshold": threshold,
        "precision": precision,
        "recall": recall,
        "false": false,
    }


def draw_curve(log: Path, picture: Path) -> None:
    """Draw a log: average precision and loss over the minutes, as a PNG."""

    with open(log) as file:
        rows = [{key: float(value) for key, value in row.items()} for row in csv.DictReader(file)]
    canvas = np.full((360, 640, 3), 255, np.uint8)
    left, right, top, bottom = 50, 620, 30, 320
    longest = max([row["minutes"] for row in rows] + [1.0])
    for step in range(0, 11, 2):
        y = round(bottom - (bottom - top) * step / 10)
        cv2.line(canvas, (left, y), (right, y), (225, 225, 225), 1)
        cv2.putText(
            canvas, f"{step / 10:.1f}", (14, y + 4), cv2.FONT_HERSHEY_SIMPLEX, 0.4, (60, 60, 60), 1, cv2.LINE_AA
        )
    for minute in np.linspace(0, longest, 6):
        x = round(left + (right - left) * minute / longest)
        cv2.putText(
            canvas, f"{minute:.0f}", (x - 8, bottom + 18), cv2.FONT_HERSHEY_SIMPLEX, 0.4, (60, 60, 60), 1, cv2.LINE_AA
        )
    cv2.putText(canvas, "minutes", (310, 352), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (60, 60, 60), 1, cv2.LINE_AA)
    lines = (
        ("ap", "AP50, 12 px and more", (180, 90, 0)),
        ("ap_small", "AP50, 12 to 20 px", (0, 130, 220)),
        ("loss", "loss / 10", (120, 120, 120)),
    )
    for number, (name, text, colour) in enumerate(lines):
        scale = 0.1 if name == "loss" else 1.0
        points = [
            (
                round(left + (right - left) * row["minutes"] / longest),
                round(bottom - (bottom - top) * min(row[name] * scale, 1.0)),
            )
            for row in rows
        ]
        cv2.polylines(canvas, [np.array(points, np.int32)], False, colour, 2, cv2.LINE_AA)
        cv2.putText(canvas, text, (60 + 190 * number, 20), cv2.FONT_HERSHEY_SIMPLEX, 0.45, colour, 1, cv2.LINE_AA)
    cv2.imwrite(str(picture), canvas)


class Trainer:
    """A training: the network, its running mean, the batches and the progress.

    Several processes, each with a thread and a part of the batch, train one network: on a busy machine this is faster
    than one process whose threads wait for each other in every layer.
    """

    def __init__(self, arguments: argparse.Namespace, rank: int = 0):
        self.options, self.rank = arguments, rank
        torch.manual_seed(arguments.seed)
        torch.set_num_threads(1)
        cv2.setNumThreads(1)
        self.network = Darknet(arguments.cfg).to(memory_format=torch.channels_last)
        begin(self.network)
        if arguments.start:
            load_weights(self.network, arguments.start)
        self.average = Average(self.network)
        decayed = [p for p in self.network.parameters() if p.ndim > 1]
        others = [p for p in self.network.parameters() if p.ndim <= 1]
        groups = [{"params": decayed, "weight_decay": 0.02}, {"params": others, "weight_decay": 0.0}]
        self.optimizer = torch.optim.AdamW(groups, lr=arguments.rate, betas=(0.9, 0.99))
        self.spent, self.steps = 0.0, 0
        self.begun, self.before = time.monotonic(), 0.0
        arguments.out.mkdir(parents=True, exist_ok=True)
        if arguments.resume:
            self._resume()
        chance = 1000 * arguments.seed + 10 * self.steps + rank
        cropper = Cropper(arguments.crop, chance, arguments.negatives, arguments.paste)
        folder = arguments.data / "train"
        read = load(cropper, folder)
        if not cropper.with_people:
            raise SystemExit(f"{folder} has no images with people")
        val = arguments.data / "val"
        self.val = [read_picture(val, label) for label in read_labels(val)[: arguments.val]]
        if rank == 0:
            print(
                f"{len(cropper.pictures)} images, {len(cropper.sprites)} people cut out, {len(self.val)} for validation"
            )
        self.feeder = Feeder(cropper, arguments.batch // arguments.processes, folder, read)
        self.feeder._read_hard()

    def _resume(self) -> None:
        state = torch.load(self.options.out / "state.pt", weights_only=True)
        self.network.load_state_dict(state["network"])
        self.average.network.load_state_dict(state["average"])
        self.optimizer.load_state_dict(state["optimizer"])
        self.spent, self.steps = state["spent"], state["steps"]
        self.average.steps = self.steps

    def save(self) -> None:
        """Write the state, from which training can continue, and the weights for detection."""
        out = self.options.out
        state = {
            "network": self.network.state_dict(),
            "average": self.average.network.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "spent": self.spent,
            "steps": self.steps,
        }
        torch.save(state, out / "state.part")
        (out / "state.part").rename(out / "state.pt")
        sealed = copy.deepcopy(self.average.network)
        seal(sealed)
        save_weights(sealed, out / "last.part")
        (out / "last.part").rename(out / "last.weights")

    def _minutes(self) -> float:
        """Return the duration of the training; a file ``minutes`` in its folder changes it during the run."""
        path = self.options.out / "minutes"
        return float(path.read_text()) if path.exists() else self.options.minutes

    def rate(self) -> float:
        """Return the current learning rate: a warm-up of 200 steps, then a cosine down to a hundredth at the end."""
        done = min(self.spent / (60 * self._minutes()), 1.0)
        cosine = 0.01 + 0.99 * 0.5 * (1 + math.cos(math.pi * done))
        return self.options.rate * cosine * min(1.0, (self.steps + 1) / 200)

    def step(self) -> dict[str, float]:
        """Train on one batch; return the loss and its parts."""
        images, people = self.feeder.queue.get()
        with torch.autocast("cpu", torch.bfloat16, enabled=self.options.bf16):
            outputs = [output.float() for output in self.network(tensor(images))]
        loss, parts = detection_loss(self.network.heads, outputs, torch.from_numpy(people))
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()
        self._share()
        for group in self.optimizer.param_groups:
            group["lr"] = self.rate()
        torch.nn.utils.clip_grad_norm_(self.network.parameters(), 10.0)
        self.optimizer.step()
        if self.rank == 0:
            self.average.update(self.network)
        self.steps += 1
        return {"loss": float(loss.detach()), **parts}

    def _share(self) -> None:
        """Replace gradients and elapsed time with their means over all processes."""
        now = self.before + time.monotonic() - self.begun
        if self.options.processes == 1:
            self.spent = now
            return
        gradients = [p.grad for p in self.network.parameters() if p.grad is not None]
        flat = torch.cat([gradient.reshape(-1) for gradient in gradients] + [torch.tensor([now])])
        dist.all_reduce(flat)
        flat /= self.options.processes
        start = 0
        for gradient in gradients:
            gradient.copy_(flat[start : start + gradient.numel()].view_as(gradient))
            start += gradient.numel()
        self.spent = float(flat[-1])

    def follow(self) -> None:
        """Train alongside the process that writes the log."""
        self.feeder.start()
        self.begun, self.before = time.monotonic(), self.spent
        while self.spent < 60 * self._minutes():
            self.step()

    def run(self) -> None:
        """Train until the duration has passed."""
        options = self.options
        self.feeder.start()
        log = options.out / "log.csv"
        fresh = not (options.resume and log.exists())
        self.begun, self.before = time.monotonic(), self.spent
        judged, sums, count = self.spent, {}, 0
        with open(log, "w" if fresh else "a", newline="") as file:
            names = ["minutes", "steps", "crops_per_s", "loss", "box", "object", "iou", "ap", "ap_small"]
            names += ["threshold", "precision", "recall", "false"]
            writer = csv.DictWriter(file, names)
            if fresh:
                writer.writeheader()
            lap, lap_steps = time.monotonic(), self.steps
            while self.spent < 60 * self._minutes():
                for name, value in self.step().items():
                    sums[name] = sums.get(name, 0.0) + value
                count += 1
                over = self.spent >= 60 * self._minutes()
                if self.spent - judged < 60 * options.judge and not over:
                    continue
                speed = (self.steps - lap_steps) * options.batch / (time.monotonic() - lap)
                marks = judge(self.average.network, self.val) if self.val else {}
                row = {"minutes": self.spent / 60, "steps": self.steps, "crops_per_s": speed}
                row |= {name: value / count for name, value in sums.items()} | marks
                writer.writerow({name: f"{value:.5g}" for name, value in row.items()})
                file.flush()
                self.save()
                draw_curve(log, options.out / "curve.png")
                print("  ".join(f"{name} {value:.4g}" for name, value in row.items()), flush=True)
                lap, lap_steps = time.monotonic(), self.steps
                judged, sums, count = self.spent, {}, 0


def train(rank: int, arguments: argparse.Namespace) -> None:
    """Train in one of the processes."""
    if arguments.processes > 1:
        meeting = f"file://{(arguments.out / 'processes').resolve()}"
        dist.init_process_group("gloo", init_method=meeting, rank=rank, world_size=arguments.processes)
    trainer = Trainer(arguments, rank)
    if rank == 0:
        trainer.run()
    else:
        trainer.follow()


def main() -> None:
    """Train."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path, help="folder of make_data.py, with train/ and val/")
    parser.add_argument("--out", type=Path, required=True, help="folder for weights, state, log and curve")
    parser.add_argument("--cfg", type=Path, default=CONFIG, help="configuration of the network (%(default)s)")
    parser.add_argument("--minutes", type=float, default=60.0, help="length of the training (%(default)s)")
    parser.add_argument("--resume", action="store_true", help="continue from RUN/state.pt")
    parser.add_argument("--start", type=Path, help="initial .weights")
    parser.add_argument("--batch", type=int, default=32, help="crops per step (%(default)s)")
    parser.add_argument("--crop", type=int, default=192, help="side of a crop, px, a multiple of 32 (%(default)s)")
    parser.add_argument("--rate", type=float, default=3e-3, help="maximum learning rate (%(default)s)")
    parser.add_argument(
        "--negatives", type=float, default=0.35, help="share of crops not centred on people (%(default)s)"
    )
    parser.add_argument("--paste", type=float, default=0.5, help="share of crops with pasted people (%(default)s)")
    parser.add_argument(
        "--judge", type=float, default=4.0, help="minutes between two evaluations on val/ (%(default)s)"
    )
    parser.add_argument("--val", type=int, default=120, help="number of evaluated images of val/ (%(default)s)")
    parser.add_argument("--bf16", action="store_true", help="compute in bfloat16: faster where the processor has it")
    parser.add_argument("--processes", type=int, default=2, help="number of processes that share a batch (%(default)s)")
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    if arguments.processes == 1:
        train(0, arguments)
    else:
        arguments.out.mkdir(parents=True, exist_ok=True)
        (arguments.out / "processes").unlink(missing_ok=True)
        mp.spawn(train, (arguments,), arguments.processes)


if __name__ == "__main__":
    main()
