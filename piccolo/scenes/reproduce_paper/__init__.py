"""The paper's experiments: what is varied, on transformed copies of scenes, beside the paper's figures."""
