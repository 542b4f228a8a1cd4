#!/usr/bin/env python3
from _checkout import run

run(__name__, "research.datasets.true_poses")
