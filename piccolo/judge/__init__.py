"""Decisions: probabilities go in, a belief comes out, and its status. Nothing here is searched or measured.

Whatever helps a photo changes its `Belief` in one respect, or gives a pose with errors:
- `localization.judge`: evidence of the photo alone gives `place`, its errors `within`, its camera `doubt`;
- `localization.bundle`: `believe_together`, by photos whose relative poses are known;
- `localization.beside`: `believe_beside`, by a photo that shows the same;
- `localization.localize`: `share_place` among results with several focal lengths;
- `judge.follow_consensus` of `localization`: `doubt`, by all photos of a camera;
- `walk.results`: `place`, by the path of the camera.
"""
