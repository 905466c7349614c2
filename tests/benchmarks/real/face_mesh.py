"""Find MediaPipe's face mesh in frames of a video: python face_mesh.py VIDEO FRAME ...

Runs in an environment of its own with mediapipe 0.10.21, the last series whose package holds the models of the face
mesh. Prints a JSON list: for every frame the landmarks as [x, y, z], all in px, or null where no face is found.
"""

import json
import sys

import cv2
import mediapipe

CONFIDENCE = 0.1  # of the face detector: pictures of a mouth alone show less than half a face


def main() -> None:
    """Print the landmarks of the frames."""
    wanted = [int(number) for number in sys.argv[2:]]
    mesh = mediapipe.solutions.face_mesh.FaceMesh(static_image_mode=True, min_detection_confidence=CONFIDENCE)
    reader, found = cv2.VideoCapture(sys.argv[1]), {}
    for number in range(max(wanted) + 1):
        if not reader.grab():
            raise SystemExit(f"{sys.argv[1]} ends before frame {number}")
        if number in wanted:
            picture = reader.retrieve()[1]
            height, width = picture.shape[:2]
            faces = mesh.process(cv2.cvtColor(picture, cv2.COLOR_BGR2RGB)).multi_face_landmarks
            points = faces[0].landmark if faces else None
            found[number] = points and [[one.x * width, one.y * height, one.z * width] for one in points]
    print(json.dumps([found[number] for number in wanted]))


if __name__ == "__main__":
    main()
