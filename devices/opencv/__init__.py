"""Whatever OpenCV's VideoCapture opens: V4L2 devices, streams, video files, numbered pictures."""
