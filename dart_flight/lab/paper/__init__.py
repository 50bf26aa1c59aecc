"""The paper's tables and figures beside the model's."""
