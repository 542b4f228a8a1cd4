"""The default method: it localizes a panorama in a prepared scan.

A photo's way from its file to a result:
1. `api.scan_photo.localize_photo` reads it (`panorama.read_panorama`) and looks up its GPS position;
2. `run.localize` makes a `Problem` of its images and of the part of the map that the prior allows;
3. `attempts.plan_attempts` lists the searches: a brief one by views, local features, all views;
4. each search finds starts (`search.search_poses`) and refines a few of them (`beam`, on the stages of
   `ladder`) to candidates, whose evidence `evidence.examine` completes; the searches end as soon as one
   candidate is sure (`judge.selection.is_sure`);
5. `last_descent.refine_best` refines the best candidates to the end and chooses (`examine.choose`);
6. `claimed_geometry` compares the geometry that the photo claims with the scan, and refines the poses with
   the geometry found;
7. `judging.judge` gathers the case and a belief; `judge.conclude` names the reasons that rule the pose out,
   and `judge.belief` decides;
8. `place_names.add_places` names the scan and the storey; `Result.complete` adds the names of the files.
"""
