"""What users see of a run: figures, animations, TensorBoard, tables."""
