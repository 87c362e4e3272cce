"""What is measured: a package a task, and beneath them what the tasks share."""
