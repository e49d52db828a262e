"""What is cut goes on, and what is on disk is whole: artifacts, parallel work, GL, the order of imports."""
