"""Decisions: candidates and probabilities go in, a belief and a status come out. Nothing is searched here.

Each source of evidence changes one respect of a photo's `Belief`, or gives a pose with its errors:
- `localization.judging`: evidence of the photo alone gives `place`, its errors `within`, its camera `doubt`;
- `together.bundle`, `together.group`: `believe_together`, by photos whose relative poses are known or found;
- `together.nearby`: `believe_nearby` and `believe_exact`, by where the other photos of its group were taken;
- `together.mirrored`: `ruled_out`, if photos of one place fit better mirrored;
- `together.beside`: `believe_beside`, by a photo that shows the same;
- `localization.run`: `share_place` among results with several focal lengths;
- `judge.conclude`: `follow_consensus`, `doubt` by all photos of a camera (called by `together.second_looks`);
- `together.walk`: `place`, by the path of the camera.
A new way for photos to help each other adds its function to `judge.by_others`, and a job that calls it.
"""
