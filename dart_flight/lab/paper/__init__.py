"""The paper's tables beside the model's."""
