// The console's start: takes a one-time login out of the address, then shows the login or the console.
import "leaflet/dist/leaflet.css";
import "./style.css";
import { render } from "preact";
import { useEffect, useState } from "preact/hooks";
import { Problem } from "./api/client";
import type { Session } from "./api/types";
import { ConsoleApp } from "./app";
import { mayOperate } from "./context";
import { Notice } from "./dialog";
import { startLanguage, t } from "./i18n/i18n";
import { currentSession, logIn, logOut, Login } from "./login";
import { go, takeLogin, usePage } from "./router";
import { rememberedRobots, sentence, StopBar } from "./stop";
import { startTheme } from "./theme";
import { forgetChanges } from "./views/zones";
import { CodesPage } from "./visit/codes";
import { NoCode, VisitApp } from "./visit/visit";
import { editor } from "./zones/editor";

/** How often a page that is shown, such as a tablet on a wall, keeps its login alive. */
const KEEP_MS = 3_600_000;

/** Begin with a one-time login, else with the session that the browser has; null: nobody is logged in. */
async function begin(token: string | null, ofCode: boolean): Promise<Session | null> {
  try {
    // Who scans another code keeps their session: a new one would not know of their visit.
    if (ofCode) {
      const known = await begin(null, false);
      if (known !== null) return known;
    }
    return token === null ? await currentSession() : await logIn(token);
  } catch (error) {
    // A one-time login that was used before: the browser may still have its session.
    if (token !== null && error instanceof Problem && error.status === 401) return begin(null, false);
    return null;
  }
}

function Root({ first }: { readonly first: string | null }): preact.JSX.Element | null {
  const [login, setLogin] = useState({ token: first });
  const [session, setSession] = useState<Session | null | undefined>(undefined);
  const [notice, setNotice] = useState("");
  const [said, setSaid] = useState("");
  /** Why the last attempt to log out failed. */
  const [problem, setProblem] = useState("");
  const page = usePage();
  useEffect(() => void begin(login.token, page.name === "visit").then((found) => setSession((before) => found ?? before ?? null)), [login]);
  useEffect(() => {
    // A code that is opened where the page is shown already changes only what is behind the #.
    const changed = (): void => {
      const token = takeLogin();
      if (token !== null) setLogin({ token });
    };
    addEventListener("hashchange", changed);
    return () => removeEventListener("hashchange", changed);
  }, []);
  useEffect(() => {
    if (!session) return undefined;
    // Each time it is asked for, a session lasts twelve hours more; what else the page asks says when it has ended.
    const timer = setInterval(() => void currentSession().catch(() => undefined), KEEP_MS);
    return () => clearInterval(timer);
  }, [session]);
  if (session === undefined) return null;
  const leave = (why: string): void => {
    setNotice(why);
    setProblem("");
    setSession(null);
  };
  // Who leaves by hand leaves nothing to the next person at this screen; who must log in again finds their draft.
  const left = (): void => {
    editor.end();
    forgetChanges();
    go("map");
    leave("");
  };
  if (page.name === "visit" || session?.role === "guest") {
    return session === null ? <NoCode /> : <VisitApp place={page.place} onExpired={() => leave("")} />;
  }
  if (page.name === "codes" && session !== null && mayOperate(session)) return <CodesPage own={session.role === "admin"} />;
  if (session !== null) {
    return (
      <>
        <ConsoleApp
          session={session}
          onExpired={() => leave(t("login.expired"))}
          onLogOut={() => void logOut().then(left, (error: unknown) => setProblem(sentence(error)))}
        />
        {problem !== "" && <Notice text={t("logout.failed", { reason: problem })} onClose={() => setProblem("")} />}
      </>
    );
  }
  const robots = rememberedRobots();
  return (
    <div class="shell">
      <Login notice={notice} onSession={setSession} />
      <p class="said" role="status">{said}</p>
      {robots.length > 0 && <StopBar robot={robots.length === 1 ? robots[0] ?? null : null} robots={robots} say={setSaid} />}
    </div>
  );
}

startLanguage();
startTheme();
const root = document.getElementById("app");
if (root) render(<Root first={takeLogin()} />, root);
