"""The paper's tables compared with the model."""
