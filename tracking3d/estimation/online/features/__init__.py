"""From pixels to points: optical flow, keypoints, texture. No map and no pose."""
