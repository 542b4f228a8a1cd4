"""Decisions: pure functions of candidates and probabilities, which search and measure nothing.

Photos that help each other decide nothing either; each way hands over what it knows:
- `localization.bundle`: a pose by all photos and the probabilities of all poses, to `judge_together`;
- `localization.beside`: the mean with the pose by another photo, and how sure that is;
- `batch.localizer`: the focal length by all photos of a camera, an `Opinion`, to `follow_consensus`;
- `walk.results`: the probabilities of a frame's places along the path, its pose to `take_pose`;
- `coloring`: nothing; each photo is localized as one alone, in colours of the others.
"""
