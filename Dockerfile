# One image, one container a process: the command says which.
FROM python:3.12-slim

ENV PYTHONDONTWRITEBYTECODE=1 \
    PYTHONUNBUFFERED=1 \
    PIP_DISABLE_PIP_VERSION_CHECK=1 \
    OMP_NUM_THREADS=1

WORKDIR /opt/autospine
COPY requirements.lock ./
RUN pip install --no-cache-dir --require-hashes -r requirements.lock
COPY pyproject.toml README.md LICENSE ./
COPY service ./service
COPY dicom_listener ./dicom_listener
COPY dicom_slice ./dicom_slice
COPY sr_engine ./sr_engine
COPY robot_bridge ./robot_bridge
COPY case_record ./case_record
COPY room_config ./room_config
COPY simulator ./simulator
COPY bench ./bench
COPY studies ./studies
RUN pip install --no-cache-dir --no-deps --no-build-isolation . \
    && useradd --create-home autospine && mkdir /case && chown autospine /case

USER autospine
VOLUME /case
ENTRYPOINT ["autospine"]
