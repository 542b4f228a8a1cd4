"""Photos that help each other: bundles, groups, photos beside others, walks.

They bring evidence, and decide nothing.
- `members`: photos found by themselves, of which bundles and groups are made;
- `bundle`: photos whose relative poses are known, as one rigid camera;
- `group`: photos of one place, whose poses follow from each other's by `links`, their matches;
- `beside`: a photo that is not sure, beside others that are;
- `walk`: frames of a camera that is carried through the scan.
`judge.by_others` changes the belief in a photo by what they tell.
"""
