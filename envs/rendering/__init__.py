"""Pictures of cars: what is drawn of each (`scene`, `trace`), on what (`canvas`), and the views."""
