"""What is cut goes on, and what is on disk is whole: artifacts, parallel work, the order of imports."""
