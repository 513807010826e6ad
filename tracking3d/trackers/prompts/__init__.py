"""What the user says the object is: boxes, masks, points, and corrections of later frames."""
