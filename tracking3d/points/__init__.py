"""Long tracks of surface points: the model predicts where a point is, the image corrects it."""
