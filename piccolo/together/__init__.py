"""Photos that help each other: bundles, groups, photos beside others, walks.

These modules gather evidence; the judge decides.
- `members`: photos that were found by themselves, of which bundles and groups are made;
- `bundle`: photos whose relative poses are known, as one rigid camera;
- `group`: photos of one place, whose poses follow from each other's by `links`, their matches;
- `beside`: a photo that is not sure, by its matches with others that are;
- `walk`: frames of a camera that is carried through the scan.
`judge.by_others` changes the belief in a photo by the evidence of the others.
"""
