"""Pictures of cars: what is drawn of each (`road`, `trace`), on what (`canvas`), and the views."""
