#!/usr/bin/env python3
from _checkout import run

run(__name__, "piccolo.apps.models.align_model")
