"""The default method: it localizes a panorama in a prepared scan.

A photo's way from its file to a result:
1. `opened_scan.OpenedScan.localize` reads it (`panorama.read_panorama`) and asks for its GPS position;
2. `localize.localize` prepares its images and the part of the map that the prior allows (`problem`);
3. `attempts.plan_attempts` lists the searches: a brief one by views, local features, all views;
4. each finds starts (`search.search_poses`) and refines few of them (`beam`, on the stages of `ladder`), or
   draws the scan at poses that are known (`evidence.verification`), until one is sure (`selection.is_sure`);
5. `last_descent.refine_best` refines the best poses to the end and selects among them (`selection.select`);
6. `calibration.calibrate` or `calibrate_sphere` compares what the photo says of its geometry;
7. `judging.judge` measures the best pose, its covariance and its probability; `judge.decide` decides;
8. `result.with_localization` makes the result in the world, which a command writes.
`judge.decide` tells how photos help each other, and what each way hands over.
"""
