"""The promises about real logs. They read CARMEN text by hand: one ODOM line, then its FLASER line."""

import gzip

import numpy as np
import pytest

from hsloc.evaluation.relations import evaluate_relations, read_relations
from hsloc.model import Odometry, PairedScan, Pose2, Scan, Trajectory
from hsloc.slam.mapper import Mapper
from hsloc.slam.parameters import GraphMapperParameters

pytestmark = pytest.mark.data


def stamp(text):
    seconds, fraction = text.split(".")
    return int(seconds) * 10**9 + int(fraction.ljust(9, "0"))


def read(path):
    events = []
    with gzip.open(path, "rt") as lines:
        for line in lines:
            fields = line.split()
            if fields[0] == "ODOM":
                events.append(Odometry(stamp(fields[7]), Pose2(*map(float, fields[1:4]))))
            elif fields[0] == "FLASER":
                ranges = np.array(fields[2:182], dtype=np.float32)
                ranges[ranges > 80.0] = np.inf
                scan = Scan(events[-1].stamp_ns, ranges, -np.pi / 2, np.pi / 180, 0.02, 80.0)
                odometry = next(event for event in reversed(events) if isinstance(event, Odometry))
                events.append(PairedScan(scan, odometry.T_odom_base))
    return events


def mapped(events, seed):
    mapper = Mapper(GraphMapperParameters(), np.random.default_rng(seed))
    for event in events:
        mapper.update(event)
    return mapper.finish()


def test_intel_is_mapped_better_than_published(data):
    events = read(data / "intel" / "intel.clf.gz")
    result = mapped(events, seed=0)
    stamps = np.array([event.stamp_ns for event in events if isinstance(event, Odometry)])
    score = evaluate_relations(
        Trajectory(stamps, result.odometry_poses), read_relations(data / "intel" / "intel.relations")
    )
    assert score.matched == 2984
    # iris_lama: 0.0331 m, 0.83 deg; Cartographer, with all of the scans: 0.0229 m, 0.45 deg.
    assert score.statistics.trans_part.mean < 0.0229
    assert score.statistics.angle_deg.mean < 0.65


def test_the_loop_of_aces_closes(data):
    events = read(data / "aces" / "aces.clf.gz")
    result = mapped(events, seed=0)
    reference = np.loadtxt(data / "aces" / "aces.rbpf.txt")
    stamps = np.array([event.scan.stamp_ns for event in events if isinstance(event, PairedScan)]) * 1e-9
    rows = np.abs(stamps[None, :] - reference[:, :1]).argmin(axis=1)
    ours, theirs = result.scan_poses[rows, :2], reference[:, 1:3]
    a, b = ours - ours.mean(axis=0), theirs - theirs.mean(axis=0)
    h = a.T @ b
    theta = np.arctan2(h[0, 1] - h[1, 0], h[0, 0] + h[1, 1])
    c, s = np.cos(theta), np.sin(theta)
    assert np.hypot(*(a @ np.array(((c, s), (-s, c))) - b).T).mean() < 0.2
