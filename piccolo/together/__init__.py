"""Photos that help each other: bundles, photos beside others, walks. They bring evidence, and decide nothing.

- `bundle`: photos whose relative poses are known, as one rigid camera;
- `beside`: a photo that is not sure, beside others that are;
- `walk`: frames of a camera that is carried through the scan.
`judge.by_others` changes the belief in a photo by what they tell.
"""
