"""Every SQL statement that makes or changes the shape of a case record, oldest first.

`MIGRATIONS[n]` brings a record from version n to n + 1; the version is SQLite's `user_version`.
Set-valued columns (setpoints, covariances, headers) are JSON text: read whole, never searched.
"""

MIGRATIONS: tuple[str, ...] = (
    """
    CREATE TABLE "case" (
        case_id     INTEGER PRIMARY KEY CHECK (case_id = 1),
        case_uid    TEXT NOT NULL,
        name        TEXT NOT NULL,
        seed        INTEGER NOT NULL,
        created_s   REAL NOT NULL
    ) STRICT;

    CREATE TABLE event (
        event_id      INTEGER PRIMARY KEY,
        wall_s        REAL NOT NULL,
        monotonic_s   REAL NOT NULL,
        source        TEXT NOT NULL,
        who           TEXT NOT NULL,
        kind          TEXT NOT NULL,
        body          TEXT NOT NULL,
        previous_hash TEXT NOT NULL,
        hash          TEXT NOT NULL UNIQUE
    ) STRICT;
    CREATE TRIGGER event_is_never_changed BEFORE UPDATE ON event
        BEGIN SELECT RAISE(ABORT, 'events are append-only'); END;
    CREATE TRIGGER event_is_never_removed BEFORE DELETE ON event
        BEGIN SELECT RAISE(ABORT, 'events are append-only'); END;

    CREATE TABLE hold (
        hold_id         INTEGER PRIMARY KEY,
        set_id          INTEGER NOT NULL,
        place           INTEGER NOT NULL,
        setpoints_um    TEXT NOT NULL,
        readback_um     TEXT NOT NULL,
        shift_um        TEXT NOT NULL,
        shift_px        TEXT NOT NULL,
        settled_at_s    REAL NOT NULL,
        ended_at_s      REAL,
        expected_slices INTEGER NOT NULL CHECK (expected_slices >= 0)
    ) STRICT;
    CREATE UNIQUE INDEX one_open_hold ON hold (ended_at_s IS NULL) WHERE ended_at_s IS NULL;

    CREATE TABLE slice (
        slice_id             INTEGER PRIMARY KEY,
        sop_instance_uid     TEXT NOT NULL,
        frame                INTEGER NOT NULL,
        sha256               TEXT NOT NULL,
        path                 TEXT NOT NULL,
        state                TEXT NOT NULL CHECK (state IN ('assigned', 'pending', 'quarantined')),
        hold_id              INTEGER REFERENCES hold (hold_id),
        reason_code          TEXT NOT NULL,
        reason               TEXT NOT NULL,
        received_s           REAL NOT NULL,
        received_monotonic_s REAL NOT NULL,
        acquired_from_s      REAL,
        acquired_to_s        REAL,
        time_source          TEXT NOT NULL,
        header               TEXT NOT NULL,
        decided_by           TEXT NOT NULL,
        UNIQUE (sop_instance_uid, frame, sha256),
        CHECK ((state = 'assigned') = (hold_id IS NOT NULL))
    ) STRICT;
    CREATE INDEX slice_by_hold ON slice (hold_id);
    CREATE INDEX slice_by_state ON slice (state);

    CREATE TABLE measurement (
        measurement_id INTEGER PRIMARY KEY,
        state          TEXT NOT NULL CHECK (state IN ('requested', 'done', 'failed')),
        method         TEXT NOT NULL,
        hold_ids       TEXT NOT NULL,
        request        TEXT NOT NULL,
        requested_s    REAL NOT NULL,
        finished_s     REAL,
        result         TEXT,
        reason_code    TEXT NOT NULL DEFAULT '',
        reason         TEXT NOT NULL DEFAULT ''
    ) STRICT;

    CREATE TABLE procedure (
        procedure_id INTEGER PRIMARY KEY,
        name         TEXT NOT NULL,
        arguments    TEXT NOT NULL,
        state        TEXT NOT NULL CHECK (state IN ('running', 'done', 'failed', 'aborted')),
        result       TEXT,
        started_s    REAL NOT NULL,
        ended_s      REAL
    ) STRICT;
    CREATE UNIQUE INDEX one_running_procedure ON procedure (state) WHERE state = 'running';

    CREATE TABLE step (
        procedure_id INTEGER NOT NULL REFERENCES procedure (procedure_id),
        number       INTEGER NOT NULL,
        kind         TEXT NOT NULL,
        body         TEXT NOT NULL,
        outcome      TEXT,
        sent_s       REAL NOT NULL,
        ended_s      REAL,
        PRIMARY KEY (procedure_id, number)
    ) STRICT;

    CREATE TABLE move (
        command_id     TEXT PRIMARY KEY,
        measurement_id INTEGER REFERENCES measurement (measurement_id),
        purpose        TEXT NOT NULL,
        setpoints_um   TEXT NOT NULL,
        state          TEXT NOT NULL,
        code           TEXT NOT NULL,
        text           TEXT NOT NULL,
        readback_um    TEXT NOT NULL,
        sent_s         REAL NOT NULL,
        ended_s        REAL
    ) STRICT;
    """,
)

SCHEMA_VERSION = len(MIGRATIONS)
