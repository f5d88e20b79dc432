"""The single checks behind check.py: of the rig (array.py, seeing.py), of the images, of the masks."""
