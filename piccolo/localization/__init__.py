"""The default method: it localizes a panorama in a prepared scan.

A photo's way from its file to a result:
1. `scan_photo.localize_photo` reads it (`panorama.read_panorama`) and asks for its GPS position;
2. `run.localize` makes a `Problem` of its images and the part of the map that the prior allows;
3. `attempts.plan_attempts` lists the searches: a brief one by views, local features, all views;
4. each finds starts (`search.search_poses`) and refines few of them (`beam`, on the stages of `ladder`) to
   candidates, whose evidence `evidence.examine` completes, until one is sure (`judge.selection.is_sure`);
5. `last_descent.refine_best` refines the best candidates to the end and chooses (`examine.choose`);
6. `claimed_geometry` compares what the photo says of its geometry, and refines with what it finds;
7. `judging.judge` gathers the case and a belief; `judge.conclude` names reasons, `judge.belief` decides;
8. `place_names.add_places` names scan and storey; `Result.complete` says of which photo the result is.
"""
