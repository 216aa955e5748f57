"""The top: FastAPI app, web page, procedure, planner, kinematics, command line."""
