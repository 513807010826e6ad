"""All that changes the map: keyframes, landmarks, focal length, depth."""
