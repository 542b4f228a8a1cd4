"""The paper's experiments: what is varied, on changed copies of scenes, beside the paper's figures."""
