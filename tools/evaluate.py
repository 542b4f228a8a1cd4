#!/usr/bin/env python3
from _checkout import run

run(__name__, "research.evaluation.evaluate")
